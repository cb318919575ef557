"""What is made and what is left out, and the jobs that follow from it."""

import dataclasses
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fourd.config import load_config_schema
from fourd.errors import InputError
from fourd.io import ArchiveWriter, read_json
from fourd.plan.__main__ import main
from fourd.plan.files import read_motion, read_pair_facts, read_survey, survey_to_dict
from fourd.plan.options import PlanOptions, options_from_section
from fourd.plan.outline import count_by_rule, list_jobs
from fourd.plan.work import OK, STILL, PairFacts, choose_work, rank_pairs
from tests.unit.plan_scene import ANGLES, CAMERAS, PAIRS, TOO_WIDE, make_outline, make_scene, make_survey


def test_before_the_cameras_are_known_everything_is_made() -> None:
    work = choose_work(None, PAIRS, PlanOptions(max_pairs=1))
    assert work.matched == list(PAIRS)
    assert work.foreground == work.silhouettes == OK


def test_refused_pairs_are_left_out_with_their_reason() -> None:
    work = choose_work(make_survey(), PAIRS, PlanOptions())
    assert work.matched == ["cam00-cam01", "cam00-cam02", "cam01-cam02", "cam02-cam03"]
    assert work.pairs["cam00-cam03"] == TOO_WIDE


def test_a_pair_that_is_newer_than_the_survey_is_matched() -> None:
    assert "cam00-cam09" in choose_work(make_survey(), (*PAIRS, "cam00-cam09"), PlanOptions()).matched


def test_settings_take_decisions_away() -> None:
    options = PlanOptions(leave_out_pairs=("cam00-cam02",), foreground="never", max_pairs=2)
    work = choose_work(make_survey(), PAIRS, options)
    assert work.matched == ["cam00-cam01", "cam02-cam03"]
    assert "leave_out_pairs" in work.pairs["cam00-cam02"]
    assert "max_pairs" in work.pairs["cam01-cam02"]
    assert "plan foreground" in work.foreground


@pytest.mark.parametrize(
    ("options", "words"),
    [(PlanOptions(foreground="yes"), "auto, always, never"), (PlanOptions(leave_out_pairs=("a-b",)), "a-b")],
)
def test_settings_that_name_nothing_are_refused(options: PlanOptions, words: str) -> None:
    with pytest.raises(InputError, match=words):
        choose_work(make_survey(), PAIRS, options)


def test_no_foreground_only_where_every_film_is_still() -> None:
    still = dict.fromkeys(CAMERAS, f"{STILL}, as far as can be seen")
    assert "4 films" in choose_work(make_survey(still), PAIRS, PlanOptions()).foreground
    assert choose_work(make_survey(still), PAIRS, PlanOptions(foreground="always")).foreground == OK
    one_moves = {**still, "cam01": "ok"}
    assert choose_work(make_survey(one_moves), PAIRS, PlanOptions()).foreground == OK
    # Without a look at the films nothing is known.
    assert choose_work(make_survey(), PAIRS, PlanOptions()).foreground == OK


def test_useful_pairs_come_first_and_leave_no_camera_alone() -> None:
    facts = {name: PairFacts(OK, "planar", angle) for name, angle in zip(PAIRS, ANGLES, strict=True)}
    ranked = rank_pairs(facts)
    assert ranked[0] == "cam00-cam01"
    assert {camera for name in ranked[:2] for camera in name.split("-")} == set(CAMERAS)
    assert sorted(ranked) == sorted(PAIRS)


@given(st.permutations(range(6)))
def test_ranking_does_not_depend_on_the_order(order: list[int]) -> None:
    facts = {name: PairFacts(OK, "planar", angle) for name, angle in zip(PAIRS, ANGLES, strict=True)}
    shuffled = {PAIRS[i]: facts[PAIRS[i]] for i in order}
    assert rank_pairs(shuffled) == rank_pairs(facts)


def test_options_from_a_section() -> None:
    section = {"foreground": "auto", "leave_out_pairs": ["cam00-cam01"], "max_pairs": None}
    assert options_from_section(section) == PlanOptions(leave_out_pairs=("cam00-cam01",))


def test_jobs_without_clock_and_cameras_are_less() -> None:
    work = choose_work(make_survey(), PAIRS, PlanOptions())
    found = count_by_rule(list_jobs(make_outline(), make_survey(), work))
    given_scene = make_scene(clock_is_given=True, calibration=("cameras.json",))
    given_too = count_by_rule(list_jobs(make_outline(given_scene), make_survey(), work))
    assert found["disparity"] == 4 * (2 + 1)
    assert found["track_motion"] == 5 and found["film_cameras"] == 1
    assert "track_motion" not in given_too and "film_cameras" not in given_too
    assert {rule: given_too[rule] for rule in given_too} == {
        rule: found[rule] for rule in found if rule in given_too
    }


def test_what_is_left_out_has_no_jobs() -> None:
    survey = make_survey(silhouettes="stereo suffices")
    work = choose_work(survey, PAIRS, PlanOptions(foreground="never"))
    counts = count_by_rule(list_jobs(make_outline(), survey, work))
    assert "silhouettes" not in counts and "background_plate" not in counts
    # The frames that the background is made from are matched all the same.
    assert counts["disparity"] == 4


def test_chunks_cover_the_frames_whatever_their_size() -> None:
    work = choose_work(make_survey(), PAIRS, PlanOptions())
    jobs = [
        list_jobs(make_outline(chunk_frames=frames), make_survey(), work) for frames in (1, 7, 60, 100000)
    ]
    for rule in ("disparity", "fuse_foreground", "estimate_background", "render_frames", "train_level"):
        amounts = [sum(job.amount for job in own if job.rule == rule) for own in jobs]
        # A held view is one pose a chunk.
        bound = 0.5 if rule == "estimate_background" else 1e-9
        assert amounts == pytest.approx([amounts[-1]] * 4, rel=bound), rule
    assert len(jobs[0]) > len(jobs[1]) > len(jobs[2]) > len(jobs[3])


def write_rectification(path: Path, left: str, right: str, **changes: object) -> Path:
    meta = {
        "left": left, "right": right, "status": "ok", "kind": "planar", "angle_deg": 12.5, "size": [540, 300],
        "guard": {"disparity_low": [-90.0, -80.0], "disparity_high": [30.0, 40.0]},
    }  # fmt: skip
    with ArchiveWriter(path, {**meta, **changes}):
        pass
    return path


def test_survey_of_files_round_trips(tmp_path: Path) -> None:
    path = write_rectification(tmp_path / "a.npz", "cam00", "cam01")
    refused = {"status": TOO_WIDE, "kind": None, "angle_deg": None, "size": [0, 0], "guard": {}}
    facts = read_pair_facts([path, write_rectification(tmp_path / "b.npz", "cam00", "cam02", **refused)])
    assert facts["cam00-cam01"] == PairFacts("ok", "planar", 12.5, (540, 300), 130.0)
    assert facts["cam00-cam02"] == PairFacts(TOO_WIDE)
    survey = dataclasses.replace(make_survey(), pairs=facts)
    (tmp_path / "survey.json").write_text(json.dumps({"schema_version": 1, **survey_to_dict(survey)}))
    assert read_survey(tmp_path / "survey.json") == survey


def test_motion_counts_for_inputs_only(tmp_path: Path) -> None:
    for name in ("cam00", "cam04"):
        with ArchiveWriter(tmp_path / f"{name}.npz", {"name": name, "status": "ok"}):
            pass
    assert read_motion(sorted(tmp_path.glob("*.npz")), CAMERAS) == {"cam00": "ok"}


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"pairs": {"a-b": {}}, "silhouettes": "ok", "motion": {}}']
)
def test_a_damaged_survey_is_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "survey.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"survey\.json.*delete"):
        read_survey(path)


def test_another_archive_is_no_rectification(tmp_path: Path) -> None:
    with ArchiveWriter(tmp_path / "a.npz", {"name": "cam00"}):
        pass
    with pytest.raises(InputError, match="expected a rectification"):
        read_pair_facts([tmp_path / "a.npz"])
    with pytest.raises(InputError, match="expected motion maps"):
        read_motion([write_rectification(tmp_path / "b.npz", "cam00", "cam01")], CAMERAS)


def test_schema_defaults_equal_option_defaults() -> None:
    schema = load_config_schema()["properties"]["plan"]["properties"]
    section = {key: entry["default"] for key, entry in schema.items()}
    assert options_from_section(section) == PlanOptions()


@pytest.mark.parametrize(
    ("num_frames", "use", "status"),
    [
        (1, "auto", "ok"),
        (3, "always", "ok"),
        (3, "auto", "no background to tell them from: every camera moves"),
    ],
)
def test_silhouettes_need_a_camera_that_stands_still(
    tmp_path: Path, num_frames: int, use: str, status: str
) -> None:
    cameras = {
        "inputs": ["cam00", "cam01"],
        "cameras": {name: {"frames": [{}] * num_frames} for name in ("cam00", "cam01")},
    }
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    (tmp_path / "need.json").write_text('{"status": "ok"}')
    path = write_rectification(tmp_path / "a.npz", "cam00", "cam01")
    main(
        ["survey", "--cameras", str(tmp_path / "cameras.json"), "--need", str(tmp_path / "need.json")]
        + ["--rectification", str(path), "--silhouettes-use", use, "--output", str(tmp_path / "survey.json")]
    )
    assert read_survey(tmp_path / "survey.json").silhouettes == status


def test_plan_is_written_and_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "results" / "event"
    (folder / "sfm").mkdir(parents=True)
    (folder / "sfm" / "cameras.json").write_text('{"left_out": {}}')
    survey = {"schema_version": 1, **survey_to_dict(make_survey())}
    (folder / "survey.json").write_text(json.dumps(survey))
    speed = {"num_cores": 2, "slowness": dict.fromkeys(("compiled", "vision", "network"), 1.0)}
    (tmp_path / "speed.json").write_text(json.dumps({**speed, "gpu_slowness": None, "gpu_name": None}))
    flags = ["--outline", json.dumps(make_outline()), "--survey", str(folder / "survey.json")]
    flags += ["--cameras", str(folder / "sfm" / "cameras.json"), "--machine", str(tmp_path / "speed.json")]
    flags += ["--benchmarks", str(tmp_path / "none"), "--output", str(folder / "plan.json")]
    main(["show", *flags, "--max-pairs=2"])
    assert "2 of 6 pairs of cameras" in capsys.readouterr().out
    plan = read_json(folder / "plan.json")
    assert sum(pair["status"] == "ok" for pair in plan["pairs"].values()) == 2
    with pytest.raises(InputError, match="expected JSON"):
        main(["show", *flags[2:], "--outline", "{"])
