"""Configuration: one schema, defaults filled, faults named."""

import dataclasses
import importlib
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fourd import config
from fourd.cli import flags_from_mapping
from fourd.errors import InputError

# Section of the configuration -> the options class whose flags it becomes.
OPTIONS = {
    "ingest": "fourd.ingest.IngestOptions",
    "align": "fourd.align.options.AlignOptions",
    "align_vision": "fourd.align.vision_options.VisionOptions",
    "align_spatiotemporal": "fourd.align.spatiotemporal_options.SpatiotemporalOptions",
    "sample": "fourd.align.sample.SampleOptions",
    "recover": "fourd.sfm.recover.options.RecoverOptions",
    "frames": "fourd.frames.FramesOptions",
    "sfm": "fourd.sfm.SfmOptions",
    "rectify": "fourd.stereo.volume.RectifyOptions",
    "stereo": "fourd.stereo.check.StereoOptions",
    "silhouettes": "fourd.silhouettes.SilhouetteOptions",
    "fuse": "fourd.fuse.FuseOptions",
    "hull": "fourd.fuse.hull.HullOptions",
    "background": "fourd.background.BackgroundOptions",
    "composition": "fourd.composition.CompositionOptions",
    "render": "fourd.render.RenderOptions",
    "evaluate": "fourd.evaluate.EvaluateOptions",
    "report": "fourd.report.ReportOptions",
    "edit": "fourd.edit.options.EditOptions",
    "export": "fourd.export.ExportOptions",
    "viewer": "fourd.viewer.ViewerOptions",
}


def scene_document(**changes: object) -> dict:
    document = {
        "num_frames": 10,
        "size": [96, 54],
        "cameras": {f"cam{i:02d}": {"source": f"cam{i:02d}.mp4"} for i in range(3)},
        "calibration": ["cameras.json"],
    }
    return {**document, **changes}


def write_scene(folder: Path, **changes: object) -> Path:
    (folder / "event.yaml").write_text(yaml.safe_dump(scene_document(**changes)))
    return folder


@pytest.mark.parametrize("section", OPTIONS)
def test_schema_defaults_equal_option_defaults(section: str) -> None:
    module, name = OPTIONS[section].rsplit(".", 1)
    options = getattr(importlib.import_module(module), name)()
    schema = config.load_config_schema()["properties"][section]["properties"]
    wanted = {
        key: tuple(entry["default"]) if isinstance(entry["default"], list) else entry["default"]
        for key, entry in schema.items()
    }
    assert dataclasses.asdict(options) == wanted


def test_every_key_is_described() -> None:
    for section, entry in config.load_config_schema()["properties"].items():
        for key, leaf in entry.get("properties", {}).items():
            assert leaf.get("description"), f"{section}.{key}"


def test_unknown_key_is_named_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"unknown key 'min_pairz' in fuse; known keys are .*min_pairs"):
        config.load_config({"fuse": {"min_pairz": 3}}, {}, "event")


def test_wrong_type_and_range_are_named() -> None:
    with pytest.raises(InputError, match=r"chunk_frames is 0, expected at least 1"):
        config.load_config({"chunk_frames": 0}, {}, "event")
    with pytest.raises(InputError, match=r"chunk_frames is 'ten', expected type integer"):
        config.load_config({"chunk_frames": "ten"}, {}, "event")


def test_text_from_the_command_line_is_read_by_the_schema() -> None:
    given = {"views": {"train_frames": "7"}, "composition": {"num_filters": ["8", "8"], "crop": "null"}}
    full = config.load_config(given, {}, "event")
    assert full["views"]["train_frames"] == 7
    assert full["composition"]["num_filters"] == [8, 8]
    assert full["composition"]["crop"] is None


def test_preset_holds_whatever_the_scene_says() -> None:
    scene_settings = {"composition": {"num_filters": [8, 8, 8], "streams": "all"}}
    composition = config.load_config({"composition": "paper"}, scene_settings, "x")["composition"]
    assert (composition["head"], composition["streams"]) == ("direct", "paper")
    assert composition["num_filters"] == [28, 23, 13]
    assert config.load_config({}, {"composition": "paper"}, "x")["composition"] == composition
    with pytest.raises(InputError, match="composition is 'papr', expected a mapping of keys or one of paper"):
        config.load_config({"composition": "papr"}, {}, "x")


def test_given_wins_over_scene_settings_over_defaults() -> None:
    full = config.load_config({"views": {"train_frames": 7}}, {"views": {"train_frames": 5}}, "event")
    assert full["views"]["train_frames"] == 7
    full = config.load_config({}, {"views": {"train_frames": 5}}, "event")
    assert full["views"] == {"train_frames": 5, "heldout_frames": 300}


def test_scene_facts(tmp_path: Path) -> None:
    scene, settings = config.load_scene("event", write_scene(tmp_path, heldout=["cam01"]))
    assert scene.inputs == ("cam00", "cam02")
    assert scene.pairs == ("cam00-cam02",)
    assert settings == {}


def test_scene_faults_are_sentences(tmp_path: Path) -> None:
    faults = {
        "heldout names 'cam09', which is no camera": {"heldout": ["cam09"]},
        "expected at least 2 cameras": {"heldout": ["cam00", "cam01"]},
        "num_frames is 0, expected at least 1": {"num_frames": 0},
        "near less than far": {"depth_range": [3.0, 2.0]},
        "unknown key 'fpz'": {"fpz": 3},
    }
    for message, change in faults.items():
        with pytest.raises(InputError, match=message):
            config.load_scene("event", write_scene(tmp_path, **change))


def test_missing_scene_lists_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="known scenes are event"):
        config.load_scene("evnt", write_scene(tmp_path))


@given(st.integers(1, 500), st.integers(1, 100))
def test_chunks_cover_every_frame_once(num_frames: int, chunk_frames: int) -> None:
    chunks = config.chunk_names(num_frames, chunk_frames)
    frames = [f for chunk in chunks for f in config.frames_of_chunk(chunk)]
    assert frames == list(range(num_frames))


@given(st.integers(1, 500), st.integers(1, 100))
def test_spread_frames_are_distinct_and_inside(num_frames: int, count: int) -> None:
    frames = config.spread_frames(num_frames, count)
    assert len(frames) == min(count, num_frames)
    assert list(frames) == sorted(set(frames))
    assert frames[0] >= 0
    assert frames[-1] < num_frames


def test_flags_quote_what_a_shell_would_eat() -> None:
    assert flags_from_mapping({"some_key": "a; rm -rf b", "flag": True, "sizes": [1, 2], "none": None}) == (
        "'--some-key=a; rm -rf b' --flag=true --sizes 1 2 --none=none"
    )
