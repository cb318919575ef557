import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd.align.clock import CameraClock, Offsets, PairDelay, read_offsets, write_offsets
from fourd.align.request import ClockRequest, check_request
from fourd.errors import InputError

SECONDS = st.floats(-3600, 3600)


def test_convention_common_time_is_offset_plus_scaled_own_time():
    clock = CameraClock(offset_s=2.0, rate_ppm=100.0)
    assert clock.common_time(np.array([0.0, 10.0])) == pytest.approx([2.0, 12.001], abs=1e-12)


@given(offset_s=SECONDS, rate_ppm=st.floats(-500, 500), own_s=st.floats(0, 3600))
def test_own_time_is_the_inverse(offset_s, rate_ppm, own_s):
    clock = CameraClock(offset_s, rate_ppm)
    assert float(clock.own_time(clock.common_time(np.array(own_s)))) == pytest.approx(own_s, abs=1e-9)


def make_offsets() -> Offsets:
    return Offsets(
        reference="cam00",
        clocks={
            "cam00": CameraClock(0.0, method="reference"),
            "cam01": CameraClock(-0.25, 12.5, 1e-3, 0.9, "audio"),
            "cam02": CameraClock(0.0, score=0.0, method="audio", status="it is silent"),
        },
        start_s=0.125,
        pairs=(PairDelay("cam00", "cam01", -0.25, 1e-3, 0.9, "audio", 12.5),),
        notes=("cam02 is silent",),
    )


def test_offsets_read_back_equal(tmp_path):
    write_offsets(tmp_path / "offsets.json", make_offsets())
    assert read_offsets(tmp_path / "offsets.json") == make_offsets()


@pytest.mark.parametrize(
    "change",
    [
        {"cameras": {"cam00": {"shift": 1}}},
        {"cameras": {"cam00": {"offset_s": None}}},
        {"cameras": 7},
        {"start_s": []},
        {"schema_version": 99},
    ],
)
def test_other_files_are_refused(tmp_path, change):
    path = tmp_path / "offsets.json"
    write_offsets(path, make_offsets())
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError, match=r"expected offsets of the stage align in .*offsets\.json"):
        read_offsets(path)


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        (ClockRequest(("a", "b"), ("c",)), "expected held-out cameras of a, b and 2 others, got c"),
        (ClockRequest(("a", "b"), ("b",)), "2 others, got b"),
        (ClockRequest(("a", "b"), fps=0), "expected fps above 0"),
    ],
)
def test_requests_that_make_no_sense_are_refused(request_, expected):
    with pytest.raises(InputError, match=expected):
        check_request(request_)


def test_inputs_keep_the_scene_order():
    assert ClockRequest(("c", "a", "b"), ("a",)).inputs == ("c", "b")
