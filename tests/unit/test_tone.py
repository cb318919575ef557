"""Colour tables: identity, interpolation in time, bad documents."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd.errors import InputError
from fourd.tone import apply_tone, identity_table, table_at

PICTURE = np.random.default_rng(0).integers(0, 256, (7, 9, 3), dtype=np.uint8)


def test_identity_changes_nothing_and_copies():
    out = apply_tone(PICTURE, identity_table())
    np.testing.assert_array_equal(out, PICTURE)
    out[:] = 0
    assert PICTURE.any()


def test_each_channel_has_its_own_row():
    table = np.random.default_rng(1).integers(0, 256, (3, 256), dtype=np.uint8)
    out = apply_tone(PICTURE, table)
    for channel in range(3):
        np.testing.assert_array_equal(out[..., channel], table[channel][PICTURE[..., channel]])


@given(st.floats(-5, 40))
def test_tables_are_linear_between_frames_and_hold_outside(frame):
    low, high = np.full((3, 256), 10), np.full((3, 256), 110)
    table = table_at({"frames": [5, 25], "tables": [low.tolist(), high.tolist()]}, frame)
    assert table is not None and table.dtype == np.uint8
    expected = np.rint(10 + 100 * np.clip((frame - 5) / 20, 0, 1))
    assert np.abs(table.astype(float) - expected).max() <= 1e-9


def test_one_table_serves_all_frames_and_none_means_none():
    tone = {"frames": [12], "tables": [identity_table().tolist()]}
    for frame in (0, 12, 99):
        np.testing.assert_array_equal(table_at(tone, frame), identity_table())
    assert table_at(None, 3) is None


@pytest.mark.parametrize(
    "tone",
    [
        {},
        {"frames": [], "tables": []},
        {"frames": [1, 1], "tables": [identity_table().tolist()] * 2},
        {"frames": [1], "tables": [[[0] * 256] * 2]},
        {"frames": [1], "tables": [[[300] * 256] * 3]},
        {"frames": [1], "tables": [[[0] * 255 + ["x"]] * 3]},
    ],
)
def test_a_document_that_is_no_table_is_refused(tone):
    with pytest.raises(InputError, match="expected a colour table per listed frame"):
        table_at(tone, 0)


@pytest.mark.parametrize(
    "image, table",
    [
        (PICTURE[..., 0], identity_table()),
        (PICTURE.astype(float), identity_table()),
        (PICTURE, identity_table()[:2]),
        (PICTURE, identity_table().astype(int)),
    ],
)
def test_other_shapes_and_types_are_refused(image, table):
    with pytest.raises(ValueError, match="expected"):
        apply_tone(image, table)
