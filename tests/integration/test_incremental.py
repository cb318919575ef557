"""What a change makes again and what it leaves alone, and whether planning does: counted, job by job."""

import os
import shutil
from pathlib import Path

import pytest

from fourd.io import Archive, read_json
from tests.conftest import Workspace
from tests.workflow.test_job_graph import job_counts

CAMERAS = tuple(f"cam{i:02d}" for i in range(6))
NEEDS_FRAMES = ("disparity", "foreground", "background")


def event_scene(cameras: tuple[str, ...] = CAMERAS[:5], num_frames: int = 6, **settings: object) -> dict:
    """Five of six films of the tiny event, in a folder as anyone's films are; outer pairs are too wide."""
    return {
        "fps": 30,
        "num_frames": num_frames,
        "size": [96, 54],
        "cameras": {name: {"source": f"footage/frames/{name}"} for name in cameras},
        "heldout": ["cam02"],
        "clock": "given",
        "calibration": ["footage/cameras.json"],
        "settings": {
            "chunk_frames": 3,
            "views": {"train_frames": 3, "heldout_frames": 2},
            "background": {"num_samples": 3},
            "composition": {"num_filters": [4, 4, 4], "epochs": 2},
            "trajectories": {"hold_view": {"kind": "hold"}},
            **settings,
        },
    }


def to_do(workspace: Workspace, *arguments: str) -> dict[str, int]:
    """Rule -> number of jobs that are left to do, targets apart."""
    output = workspace.snakemake("-n", "--quiet", "rules", "host", *arguments, "--", "render_all").stdout
    if "Nothing to be done" in output:
        return {}
    counts = job_counts(output)
    return {rule: count for rule, count in counts.items() if rule != "render_all"}


@pytest.fixture(scope="module")
def footage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames of six cameras, 14 degrees from one to the next."""
    workspace = Workspace(tmp_path_factory.mktemp("footage"))
    scene = event_scene(CAMERAS, num_frames=8, demo={"arc_deg": 70})
    scene["cameras"] = {name: {"source": f"data/demo/frames/{name}"} for name in CAMERAS}
    workspace.write_scene("demo", scene | {"calibration": ["data/demo/cameras.json"]})
    targets = [f"data/demo/frames/{name}" for name in CAMERAS]
    result = workspace.snakemake("--cores", "2", *targets, "data/demo/cameras.json")
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace.folder / "data" / "demo"


def new_workspace(folder: Path, footage: Path, scene: dict) -> Workspace:
    workspace = Workspace(folder)
    shutil.copytree(footage, folder / "footage", copy_function=os.link)
    workspace.write_config({"scene": "event"})
    workspace.write_scene("event", scene)
    return workspace


@pytest.fixture(scope="module")
def planned_first(tmp_path_factory: pytest.TempPathFactory, footage: Path) -> Workspace:
    workspace = new_workspace(tmp_path_factory.mktemp("first"), footage, event_scene())
    before = to_do(workspace)
    assert before["disparity"] == 6 * 3, "an upper bound"
    result = workspace.snakemake("--cores", "2", "--", "plan")
    assert result.returncode == 0, result.stdout[-4000:]
    (workspace.folder / "plan.txt").write_text(result.stdout)
    return workspace


@pytest.fixture(scope="module")
def never_planned(tmp_path_factory: pytest.TempPathFactory, footage: Path) -> Workspace:
    workspace = new_workspace(tmp_path_factory.mktemp("never"), footage, event_scene())
    result = workspace.snakemake("--cores", "2", "--", "render_all")
    assert result.returncode == 0, result.stdout[-4000:]
    return workspace


def test_plan_says_what_is_left_out_and_finishes_nothing_else(planned_first: Workspace) -> None:
    text = (planned_first.folder / "plan.txt").read_text()
    assert "the scene file gives it" in text
    assert "degrees apart" in text
    plan = read_json(planned_first.folder / "results/event/plan/plan.json")
    refused = [name for name, pair in plan["pairs"].items() if pair["status"] != "ok"]
    assert 0 < len(refused) < 6
    assert not (planned_first.folder / "results/event/disparity").exists()


def test_after_planning_a_dry_run_shows_the_jobs_that_will_run(planned_first: Workspace) -> None:
    plan = read_json(planned_first.folder / "results/event/plan/plan.json")
    usable = [name for name, pair in plan["pairs"].items() if pair["status"] == "ok"]
    counts = to_do(planned_first)
    assert counts["disparity"] == len(usable) * 3
    for rule in ("probe_camera", "import_cameras", "rectify_pair", "survey", "judge_need"):
        assert rule not in counts
    assert sum(counts.values()) == plan["forecast"]["jobs_left"]


def test_a_run_without_a_plan_makes_no_empty_disparities(never_planned: Workspace) -> None:
    folder = never_planned.folder / "results/event"
    pairs = read_json(folder / "plan/survey.json")["pairs"]
    usable = {name for name, pair in pairs.items() if pair["status"] == "ok"}
    assert {path.name for path in (folder / "disparity").iterdir()} == usable
    assert to_do(never_planned) == {}


def test_planning_later_makes_nothing_again(never_planned: Workspace) -> None:
    for _ in range(2):
        result = never_planned.snakemake("--cores", "1", "--", "plan")
        assert result.returncode == 0, result.stdout[-4000:]
        assert " 0 of " in result.stdout
    assert to_do(never_planned) == {}


def test_a_budget_is_planned_first(planned_first: Workspace) -> None:
    shutil.rmtree(planned_first.folder / "results/machine")
    refused = planned_first.snakemake("--cores", "1", "--config", "minutes=0.001", "--", "render_all")
    assert refused.returncode != 0
    assert "run the target `plan`" in " ".join(refused.stdout.split())
    assert not (planned_first.folder / "results/event/disparity").exists()


def test_a_budget_takes_the_same_work_again(never_planned: Workspace) -> None:
    arguments = ("--config", "minutes=0.001")
    result = never_planned.snakemake("--cores", "1", *arguments, "--", "plan")
    assert "does not fit even with the least work" in result.stdout, result.stdout[-2000:]
    budget = read_json(never_planned.folder / "results/event/plan/plan.json")["budget"]
    assert (budget["num_samples"], budget["epochs"], budget["fits"]) == (1, 1, False)
    first = to_do(never_planned, *arguments)
    assert {"disparity", "estimate_background", "train_level"} <= set(first)
    assert "rectify_pair" not in first
    assert to_do(never_planned, *arguments) == first


def test_fewer_pairs_run_what_depends_on_them(never_planned: Workspace) -> None:
    counts = to_do(never_planned, "--config", "plan={max_pairs: 2}")
    assert set(counts) == {
        "fuse_training", "fuse_foreground", "estimate_background", "train_level", "render_frames",
        "encode_film", "evaluate_camera", "collect_metrics",
    }  # fmt: skip


def test_a_trajectory_runs_for_itself_only(never_planned: Workspace) -> None:
    films = {"hold_view": {"kind": "hold"}, "low": {"kind": "hold", "position": 0.2}}
    never_planned.write_scene("event", event_scene(trajectories=films))
    counts = to_do(never_planned)
    never_planned.write_scene("event", event_scene())
    assert counts == {
        "place_view": 1,
        "fuse_foreground": 2,
        "estimate_background": 2,
        "render_frames": 2,
        "encode_film": 1,
    }


def test_a_camera_is_probed_alone(never_planned: Workspace) -> None:
    """World, colours and background are made from all cameras: with one more they are made again."""
    never_planned.write_scene("event", event_scene(CAMERAS))
    counts = to_do(never_planned)
    never_planned.write_scene("event", event_scene())
    assert counts["probe_camera"] == counts["sample_camera"] == 1
    assert counts["rectify_pair"] == 10


def test_frames_at_the_end_are_not_probed_again(never_planned: Workspace) -> None:
    never_planned.write_scene("event", event_scene(num_frames=8))
    counts = to_do(never_planned)
    never_planned.write_scene("event", event_scene())
    assert "probe_camera" not in counts
    assert counts["sample_camera"] == 5
    # Colours, moments of the background and frames to train on are spread over the whole clip.
    assert counts["match_colours"] == counts["train_level"] == 1


def frame_arrays(workspace: Workspace) -> dict[tuple[str, ...], bytes]:
    """(stage, pair or view, frame, array) -> bytes, whatever chunk it lies in."""
    found = {}
    for stage in NEEDS_FRAMES:
        for path in sorted((workspace.folder / "results/event" / stage).glob("*/*.npz")):
            archive = Archive(path)
            for frame in archive.frames():
                for key, array in archive.frame(frame).items():
                    kind = "samples" if path.stem == "samples" else "chunk"
                    found[stage, path.parent.name, kind, f"{frame:06d}", key] = array.tobytes()
            archive.close()
    return found


def test_chunks_of_any_length_give_the_same_bytes(
    never_planned: Workspace, footage: Path, tmp_path: Path
) -> None:
    """Of frames, disparities and foregrounds; a background stores equal poses of a chunk once."""
    whole = frame_arrays(never_planned)
    for chunk_frames in (1, 6):
        scene = event_scene(chunk_frames=chunk_frames)
        workspace = new_workspace(tmp_path / str(chunk_frames), footage, scene)
        chunks = ["000000-000005"] if chunk_frames == 6 else [f"{f:06d}-{f:06d}" for f in range(6)]
        targets = [f"results/event/foreground/hold_view/{chunk}.npz" for chunk in chunks]
        result = workspace.snakemake("--cores", "2", *targets)
        assert result.returncode == 0, result.stdout[-4000:]
        arrays = frame_arrays(workspace)
        assert {key[0] for key in arrays} == {"disparity", "foreground"}
        for key, content in arrays.items():
            assert content == whole[key], (chunk_frames, key)
