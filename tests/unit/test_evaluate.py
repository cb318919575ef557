import csv
import dataclasses
import math
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fourd import cli, io, metrics, views
from fourd.baselines import METHODS
from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.evaluate import EvaluateOptions, contact_sheet, summary, table
from fourd.evaluate.__main__ import main
from fourd.evaluate.camera import COLUMNS, score_image
from fourd.geometry import look_at
from fourd.sfm import SceneCameras, write_cameras
from tests.conftest import REPOSITORY
from tests.films import put_on_clock
from tests.unit.test_metrics_fid import write_network

SIZE = (96, 64)
SCHEMA = Path(__file__).resolve().parents[2] / "config" / "schemas" / "evaluate.schema.yaml"
NAMES = ("cam00", "cam01", "cam02", "cam03")
HELDOUT = "cam01"


def texture(seed: int, size=SIZE) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.5)


def filmed(name: str, frame: int) -> np.ndarray:
    """A still place with a bright square that moves; cameras 1 and 2 see the place alike."""
    image = texture({"cam00": 1, "cam01": 2, "cam02": 2, "cam03": 3}[name]).copy()
    image[20:36, 10 + 20 * frame : 26 + 20 * frame] = (250, 250, 240)
    return image


def make_scene(folder: Path) -> None:
    tracks = {}
    for i, name in enumerate(NAMES):
        angle = np.radians(-30 + 20 * i)
        R, t = look_at(
            np.array([5 * np.cos(angle), 5 * np.sin(angle), 1.5]), np.zeros(3), np.array([0, 0, 1.0])
        )
        K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
        tracks[name] = CameraTrack(name, (Camera(K, R, t, SIZE),), 1.0, 9.0)
        for frame in range(3):
            io.write_png(folder / "source" / name / f"{frame:06d}.png", filmed(name, frame))
        put_on_clock(folder / "source" / name, name, folder / f"{name}.json", 30, 3)
    inputs = tuple(n for n in NAMES if n != HELDOUT)
    scene = SceneCameras(
        30.0,
        3,
        inputs,
        (HELDOUT,),
        tracks,
        np.zeros(3),
        1.0,
        np.array([0, 0, 1.0]),
        dict.fromkeys(NAMES, "given"),
    )
    write_cameras(folder / "cameras.json", scene)
    for name in NAMES:
        view = views.physical_view(scene, name, [0, 1, 2], None)
        views.write_view(folder / "views" / f"{name}.json", view)


def make_estimates(folder: Path) -> None:
    """Perfect background, foreground of the square's surroundings, and renders off by 3 levels."""
    with io.ArchiveWriter(folder / "foreground.npz", {"view": HELDOUT}) as writer:
        for frame in range(3):
            near = np.zeros((64, 96), bool)
            near[16:40, 8:72] = True
            image = filmed(HELDOUT, frame) * near[..., None].astype(np.uint8)
            writer.add_frame(
                frame,
                consensus_rgb=image,
                consensus_valid=near,
                depth=np.where(near, np.float32(4.8), np.float32(np.nan)),
                num_cameras=np.full((64, 96), 3, np.uint8),
            )
    with io.ArchiveWriter(
        folder / "background.npz", {"view": HELDOUT, "same_as": {"1": 0, "2": 0}}
    ) as writer:
        place = texture(2)
        seen = np.ones((64, 96), bool)
        seen[:8] = False
        filled = np.zeros_like(seen)
        filled[40:, 90:] = True
        depth = np.full((64, 96), 5, np.float32)
        writer.add_frame(0, farthest_rgb=place, farthest_valid=seen, depth=depth, filled=filled)
    for frame in range(3):
        rendered = np.clip(filmed(HELDOUT, frame).astype(int) - 3, 0, 255).astype(np.uint8)
        io.write_png(folder / "rendered" / f"{frame:06d}.png", rendered)


def make_labels(folder: Path) -> Path:
    for frame in range(3):
        labels = np.zeros((64, 96), np.uint8)
        labels[20:36, 10 + 20 * frame : 26 + 20 * frame] = 2
        io.write_png(folder / "labels" / f"{frame:06d}.png", labels)
    return folder / "labels"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("evaluate")
    make_scene(folder)
    make_estimates(folder)
    make_labels(folder)
    with io.ArchiveWriter(folder / "points.npz") as writer:
        writer.add("points", np.random.default_rng(0).uniform(-1, 1, (300, 3)))
    return folder


def camera_command(folder: Path, output: Path, **changes) -> list[str]:
    files = {
        "view-file": folder / "views" / f"{HELDOUT}.json",
        "cameras": folder / "cameras.json",
        "rendered": folder / "rendered",
        "foreground": folder / "foreground.npz",
        "background": folder / "background.npz",
        "labels": folder / "labels",
        "points": folder / "points.npz",
        **{key.replace("_", "-"): value for key, value in changes.items()},
    }
    command = ["camera", "--films", *(f"{name}={folder / name}.json" for name in NAMES)]
    for key, value in files.items():
        words = value if isinstance(value, list) else [value]
        command += [] if value is None else [f"--{key}", *map(str, words)]
    return [*command, "--output", str(output / "cam01.csv"), "--output-sheet", str(output / "cam01.png")]


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


def value_of(rows, method, region, metric, frame) -> float:
    wanted = {"method": method, "region": region, "metric": metric, "frame": str(frame)}
    (row,) = (r for r in rows if all(r[k] == v for k, v in wanted.items()))
    return float(row["value"])


def test_schema_and_options_agree():
    properties = yaml.safe_load(SCHEMA.read_text())["properties"]
    expected = {field.name: field.default for field in dataclasses.fields(EvaluateOptions)}
    assert {key: entry["default"] for key, entry in properties.items()} == expected | {"other": []}


def test_one_camera_is_scored_by_every_method(scene, tmp_path):
    main(camera_command(scene, tmp_path))
    rows = read_rows(tmp_path / "cam01.csv")
    assert tuple(rows[0]) == COLUMNS
    masks = [row for row in rows if row["method"] == "masks"]
    rows = [row for row in rows if row["method"] != "masks"]
    assert set(Counter((row["frame"], row["method"]) for row in rows if row["value"]).values()) <= {15, 17}
    assert [row["metric"] for row in masks] == 3 * ["mask_iou", "mask_precision", "mask_recall"]
    assert all(float(row["value"]) > 0.7 for row in masks)
    sources = {row["region"]: row["region_source"] for row in rows}
    assert sources == dict.fromkeys(("full", "static", "dynamic"), "truth") | dict.fromkeys(
        ("seen_1", "seen_2", "inferred", "outside_hull"), "pipeline"
    )
    assert list(dict.fromkeys(row["method"] for row in rows)) == list(METHODS)
    assert {row["view"] for row in rows} == {"cam01"}
    for frame in range(3):
        truth = filmed(HELDOUT, frame)
        assert value_of(rows, "ours", "full", "mse", frame) == 9
        assert value_of(rows, "ours", "full", "psnr_db", frame) == pytest.approx(20 * math.log10(255 / 3))
        assert value_of(rows, "background", "dynamic", "mse", frame) > 3000
        assert value_of(rows, "paste", "dynamic", "psnr_db", frame) == math.inf
        # The camera that sees the same place, with the square at the same spot, is the neighbour.
        assert value_of(rows, "nn_same_time", "full", "psnr_db", frame) == math.inf
        near = np.zeros((64, 96, 1), np.uint8)
        near[16:40, 8:72] = 1
        assert value_of(rows, "inst", "full", "mse", frame) == pytest.approx(metrics.mse(truth * near, truth))
    counts = {r["num_pixels"] for r in rows if r["region"] == "dynamic" and r["metric"] == "mse"}
    assert counts == {str(16 * 16)}
    near, blank = 24 * 64, 8 * 96
    inferred = {row["num_pixels"] for row in rows if row["region"] == "inferred" and row["value"]}
    assert inferred == {str(blank + 24 * 6)}
    for region in ("seen_1", "seen_2"):
        counts = {int(row["num_pixels"]) for row in rows if row["region"] == region and row["value"]}
        assert all(near <= count <= 64 * 96 - blank for count in counts)


def test_flicker_counts_changes_that_the_truth_does_not_have(scene, tmp_path):
    main(camera_command(scene, tmp_path))
    rows = read_rows(tmp_path / "cam01.csv")
    flicker = [row for row in rows if row["metric"] == "flicker"]
    assert {row["frame"] for row in flicker} == {"1", "2"}
    # A render that is 3 levels too dark in every frame does not flicker.
    assert {float(r["value"]) for r in flicker if r["method"] == "ours"} == {0.0}
    assert {r["num_pixels"] for r in flicker if r["region"] == "dynamic"} == {str(2 * 16 * 16)}
    still = [float(r["value"]) for r in flicker if r["method"] == "background" and r["region"] == "dynamic"]
    before, after = filmed(HELDOUT, 0).astype(float), filmed(HELDOUT, 1).astype(float)
    moved = np.abs(after - before).mean(axis=2)[(np.abs(after - before) > 0).any(axis=2)]
    assert still[0] == pytest.approx(moved.sum() / (2 * 16 * 16), rel=1e-5)
    assert value_of(rows, "background", "static", "flicker", 1) == 0


def test_every_value_that_is_missing_has_its_reason(scene, tmp_path):
    main(camera_command(scene, tmp_path, points=None))
    rows = read_rows(tmp_path / "cam01.csv")
    missing = {(r["method"], r["metric"]): r["note"] for r in rows if not r["value"]}
    assert all(missing.values())
    assert missing["ours", "lpips_alex"].startswith("no weights are given: run `python -m fourd.fetch lpips")
    assert missing["ours", "ms_ssim"] == "a side is under 176 px"
    assert (
        "no sparse points" in missing["sfm", "psnr_db"]
        and "no sparse points" in missing["sfm_dense", "psnr_db"]
    )
    assert missing["sfm_humans", "psnr_db"].startswith("no models are given: install the extra `humans`")
    notes = {row["note"] for row in rows if row["method"] == "nn_all_times" and row["value"]}
    assert notes == {"feature: thumbnail and gradient histograms"}
    text = table.draw_table(rows, summary.summarize_all(rows))
    assert "| SfM+humans | - | - | - | - | - | - |" in text
    assert "- SfM+humans: no models are given: install the extra `humans`" in text
    assert "- LPIPS (AlexNet): no weights are given" in text
    assert "- N.N. same-time, N.N. all-time: feature: thumbnail and gradient histograms" in text


def test_with_weights_neighbours_compare_conv5_and_sets_are_compared(scene, tmp_path):
    weights = REPOSITORY / "data" / "lpips"
    if not (weights / "alexnet.ckpt").is_file():
        pytest.skip(f"needs the weights: python -m fourd.fetch lpips --output {weights}")
    main([*camera_command(scene, tmp_path), "--lpips-weights", str(weights)])
    rows = read_rows(tmp_path / "cam01.csv")
    notes = {row["note"] for row in rows if row["method"] == "nn_same_time" and row["value"]}
    assert "feature: AlexNet conv5" in notes and "feature: thumbnail and gradient histograms" not in notes
    # cam02 films the same place as the held-out camera, so its picture is the nearest in every frame.
    assert value_of(rows, "nn_same_time", "full", "mse", 1) < value_of(rows, "background", "full", "mse", 1)
    lpips = {m: value_of(rows, m, "full", "lpips_alex", 2) for m in ("ours", "background")}
    assert 0 < lpips["ours"] < lpips["background"]
    sets = {(r["method"], r["metric"]): r["value"] for r in rows if r["frame"] == "all"}
    assert float(sets["ours", "frechet_alex"]) < float(sets["background", "frechet_alex"])
    assert float(sets["ours", "kernel_alex"]) < float(sets["background", "kernel_alex"])
    text = table.draw_table(rows, summary.summarize_all(rows))
    assert "over 3 frames of cam01" in text and "Frechet (AlexNet conv5)" in text


def test_fid_is_there_only_with_the_network_that_a_user_brings(scene, tmp_path):
    main(camera_command(scene, tmp_path))
    assert not any(row["metric"] == "fid" for row in read_rows(tmp_path / "cam01.csv"))
    network = write_network(tmp_path / "net.pt", 2048)
    main([*camera_command(scene, tmp_path), "--inception", str(network)])
    fid = {r["method"]: r for r in read_rows(tmp_path / "cam01.csv") if r["metric"] == "fid"}
    assert 0 < float(fid["ours"]["value"]) < float(fid["sfm"]["value"])
    assert fid["ours"]["frame"] == "all" and fid["ours"]["num_pixels"] == "3"


def test_renders_of_other_programs_are_scored_beside_ours(scene, tmp_path):
    for frame in range(3):
        image = np.clip(filmed(HELDOUT, frame).astype(int) - 6, 0, 255).astype(np.uint8)
        io.write_png(tmp_path / "splats" / HELDOUT / f"{frame:06d}.png", image)
    main(camera_command(scene, tmp_path, other=[f"splats={tmp_path / 'splats'}"]))
    rows = read_rows(tmp_path / "cam01.csv")
    assert value_of(rows, "splats", "full", "mse", 2) == 36
    assert list(dict.fromkeys(row["method"] for row in rows))[-3:] == ["splats", "ours", "masks"]
    (tmp_path / "splats" / HELDOUT / "000001.png").unlink()
    with pytest.raises(InputError, match=r"every evaluated frame of cam01, but .*000001.png is missing"):
        main(camera_command(scene, tmp_path, other=[f"splats={tmp_path / 'splats'}"]))
    io.write_png(tmp_path / "splats" / HELDOUT / "000001.png", np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(InputError, match=r"pictures of \(96, 64\) px, got \(48, 32\)"):
        main(camera_command(scene, tmp_path, other=[f"splats={tmp_path / 'splats'}"]))
    for word in ("splats", "ours=x", "=x"):
        with pytest.raises(InputError, match="expected NAME=FOLDER with a new name"):
            main(camera_command(scene, tmp_path, other=[word]))


def test_dynamic_region_without_labels_is_the_workflows_own(scene, tmp_path):
    main(camera_command(scene, tmp_path, labels=None))
    rows = read_rows(tmp_path / "cam01.csv")
    assert {row["region_source"] for row in rows} == {"pipeline"}
    counts = [int(r["num_pixels"]) for r in rows if r["region"] == "dynamic" and r["metric"] == "mse"]
    assert all(200 <= count <= 256 for count in counts)


def test_contact_sheet_shows_all_columns(scene, tmp_path):
    main([*camera_command(scene, tmp_path), "--sheet-tile-px", "96", "--sheet-frames", "2"])
    sheet = io.read_image(tmp_path / "cam01.png")
    columns = len(contact_sheet.COLUMNS)
    height = contact_sheet.HEADER_PX + 2 * (64 + contact_sheet.CAPTION_PX) + 4 * contact_sheet.GAP_PX
    assert sheet.shape == (height, columns * 96 + (columns - 1) * contact_sheet.GAP_PX, 3)
    top = contact_sheet.HEADER_PX + contact_sheet.GAP_PX
    assert (sheet[top : top + 64, :96] == filmed(HELDOUT, 0)).all()
    ours = sheet[top : top + 64, 4 * 98 : 4 * 98 + 96]
    error = sheet[top : top + 64, 5 * 98 : 5 * 98 + 96]
    assert (np.abs(ours.astype(int) - filmed(HELDOUT, 0)) * 4 == error).all()


def test_collect_joins_cameras_into_table_and_sheet(scene, tmp_path, capsys):
    main(camera_command(scene, tmp_path))
    rows = read_rows(tmp_path / "cam01.csv")
    other = [{**row, "view": "cam07"} for row in rows]
    io.write_csv(tmp_path / "cam07.csv", COLUMNS, other)
    main(
        ["collect", "--inputs", str(tmp_path / "cam01.csv"), str(tmp_path / "cam07.csv")]
        + ["--sheets", str(tmp_path / "cam01.png"), str(tmp_path / "cam01.png")]
        + ["--output", str(tmp_path / "metrics.csv"), "--output-summary", str(tmp_path / "summary.csv")]
        + ["--output-table", str(tmp_path / "table.md")]
        + ["--output-sheet", str(tmp_path / "sheet.png")]
    )
    assert read_rows(tmp_path / "metrics.csv") == rows + other
    text = (tmp_path / "table.md").read_text()
    assert text in capsys.readouterr().out
    assert "Full frame: mean and standard deviation over 6 frames of cam01, cam07, [95 % interval]" in text
    assert "Dynamic region (true masks)" in text
    assert "| ours | 9.0 +- 0.0 [9.0, 9.0] | 38.59 +- 0.00 [38.59, 38.59] |" in text
    assert "| seen by an input (" in text.replace("Dynamic region (4.2%) | ", "| ")
    summaries = {(r["region"], r["method"], r["metric"]): r for r in read_rows(tmp_path / "summary.csv")}
    found = summaries["full", "ours", "mse"]
    assert (float(found["mean"]), found["num_frames"], found["num_views"]) == (9, "6", "2")
    assert summaries["full", "sfm_humans", "psnr_db"]["mean"] == ""
    assert "| method | cam01 | cam07 |" in text
    assert "nan" not in text
    single, joined = io.read_image(tmp_path / "cam01.png"), io.read_image(tmp_path / "sheet.png")
    assert joined.shape[0] > 2 * single.shape[0] and joined.shape[1] == single.shape[1]


def test_empty_region_is_written_as_nothing_not_as_nan(scene, tmp_path):
    for frame in range(3):
        io.write_png(tmp_path / "still" / f"{frame:06d}.png", np.zeros((64, 96), np.uint8))
    main(camera_command(scene, tmp_path, labels=tmp_path / "still"))
    rows = read_rows(tmp_path / "cam01.csv")
    dynamic = [row for row in rows if row["region"] == "dynamic" and row["method"] != "masks"]
    assert {(row["value"], row["num_pixels"], row["note"]) for row in dynamic} == {
        ("", "0", "the region is empty")
    }
    assert "| ours | - | - | - | - |" in table.draw_table(rows, summary.summarize_all(rows))


def test_scores_equal_the_metrics():
    truth, image = texture(0), texture(5)
    region = np.zeros((64, 96), bool)
    region[10:40, 30:70] = True
    everything = np.ones_like(region)
    scores = {
        (name, metric): value
        for name, metric, value, _ in score_image(image, truth, {"f": everything, "d": region})
    }
    for metric, function in (("mse", metrics.mse), ("psnr_db", metrics.psnr), ("ssim", metrics.ssim)):
        assert scores["f", metric] == pytest.approx(function(image, truth), rel=1e-12)
        assert scores["d", metric] == pytest.approx(function(image, truth, region), rel=1e-12)


def test_input_camera_is_no_evidence(scene, tmp_path, capsys):
    changes = {"view_file": scene / "views" / "cam02.json"}
    assert cli.run_stage(main, camera_command(scene, tmp_path, **changes)) == 2
    assert "proves nothing" in capsys.readouterr().err


def test_missing_files_are_named(scene, tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="expected frame 0 in the files of --rendered"):
        main(camera_command(scene, tmp_path, rendered=tmp_path / "empty"))
    with pytest.raises(InputError, match="000000.png"):
        main(camera_command(scene, tmp_path, labels=tmp_path / "empty"))
    command = [word for word in camera_command(scene, tmp_path) if not word.startswith("cam03=")]
    with pytest.raises(InputError, match="expected camera cam03 in --films"):
        main(command)
    with pytest.raises(InputError, match="expected the scores of a camera"):
        table.read_metrics(tmp_path / "none.csv")
    io.write_csv(tmp_path / "other.csv", ["a"], [{"a": 1}])
    with pytest.raises(InputError, match="expected rows with view"):
        table.read_metrics(tmp_path / "other.csv")


def test_results_of_another_size_are_refused(scene, tmp_path):
    for frame in range(3):
        io.write_png(tmp_path / "small" / f"{frame:06d}.png", np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(InputError, match=r"expected pictures of \(96, 64\) px, got \(48, 32\)"):
        main(camera_command(scene, tmp_path, rendered=tmp_path / "small"))


def test_a_held_out_camera_makes_no_render():
    stages = Path(cli.__file__).parent
    readers = ("evaluate", "baselines", "report", "export")
    makers = [p for p in stages.rglob("*.py") if p.relative_to(stages).parts[0] not in readers]
    importing = [
        p.name for p in makers if "fourd.evaluate" in p.read_text() or "fourd.baselines" in p.read_text()
    ]
    assert importing == []
