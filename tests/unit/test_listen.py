import hashlib
import json
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from fourd.align.clock import read_offsets, write_offsets
from fourd.align.clock_graph import correct_sound_travel
from fourd.align.evidence import draw_evidence
from fourd.align.listen import (
    TRAVEL_SIGMA_S,
    compare_sounds,
    read_sounds,
    run_listen,
    solve_by_sound,
)
from fourd.align.options import AlignOptions
from fourd.align.sampling import TOO_SHORT
from fourd.demo.options import DemoOptions
from fourd.demo.truth import describe_phones
from fourd.errors import InputError
from tests.unit.test_audio_delay import crowd, hear

HZ = 16_000
FPS = 30
STARTS = {"cam00": 1.0, "cam01": 1.72, "cam02": 0.4, "cam03": 1.31}
DEMO = Path(__file__).resolve().parents[2] / "data" / "demo"


def write_film(path: Path, samples: np.ndarray | None, duration_s: float = 4.0) -> Path:
    """A grey film, and with samples lossless sound, Matroska."""
    with av.open(str(path), "w", format="matroska") as container:
        video = container.add_stream("ffv1", rate=FPS)
        video.width = video.height = 16
        video.pix_fmt = "yuv420p"
        sound = None if samples is None else container.add_stream("pcm_s16le", rate=HZ, layout="mono")
        for index in range(int(duration_s * FPS)):
            frame = av.VideoFrame.from_ndarray(np.full((24, 16), 128, dtype=np.uint8), format="yuv420p")
            frame.pts, frame.time_base = index, Fraction(1, FPS)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        if sound is not None and samples is not None:
            data = (np.clip(samples, -1, 1) * 32767).astype(np.int16)[None]
            frame = av.AudioFrame.from_ndarray(data, format="s16", layout="mono")
            frame.sample_rate, frame.pts, frame.time_base = HZ, 0, Fraction(1, HZ)
            container.mux(sound.encode(frame))
            container.mux(sound.encode(None))
    return path


def ingest(folder: Path, name: str, film: Path, has_audio: bool = True) -> Path:
    path = folder / f"{name}.json"
    document = {
        "camera": name,
        "kind": "video",
        "source": str(film),
        "has_audio": has_audio,
        "size": [64, 48],
        "files": [],
        "num_source_frames": 4 * FPS,
        "pts_s": [index / FPS for index in range(4 * FPS)],
        "sha256": hashlib.sha256(film.read_bytes()).hexdigest(),
    }
    path.write_text(json.dumps(document))
    return path


@pytest.fixture(scope="module")
def films(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Ingest files: four cameras of one event, and everything that can be wrong with another."""
    folder = tmp_path_factory.mktemp("films")
    event = crowd(1, 8)
    sounds = {name: hear(event, start, 4, seed) for seed, (name, start) in enumerate(STARTS.items())}
    bad = {
        "foreign": hear(crowd(99, 8), 1, 4, 9),
        "silent": np.zeros(4 * HZ, dtype=np.float32),
        "clipped": np.sign(hear(event, 1, 4, 9)),
        "dubbed": sounds["cam01"],
    }
    paths = {
        name: ingest(folder, name, write_film(folder / f"{name}.mkv", samples))
        for name, samples in (sounds | bad).items()
    }
    # Another picture, the same sound: the files differ, the recording does not.
    paths["dubbed"] = ingest(folder, "dubbed", write_film(folder / "dubbed.mkv", sounds["cam01"], 3.0))
    paths["mute"] = ingest(folder, "mute", write_film(folder / "mute.mkv", None), has_audio=False)
    paths["copy"] = ingest(folder, "copy", folder / "cam00.mkv")
    return paths


def listen(films: dict[str, Path], inputs: list[str], heldout: list[str], num_frames: int = 30):
    paths = [films[name] for name in (*inputs, *heldout)]
    return run_listen(paths, inputs, heldout, FPS, num_frames, AlignOptions())[0]


def test_clocks_of_films(films: dict[str, Path], tmp_path: Path) -> None:
    offsets = listen(films, ["cam00", "cam01", "cam02"], ["cam03"])
    assert offsets.reference == "cam00"
    for name, start_s in STARTS.items():
        clock = offsets.clocks[name]
        assert clock.status == "ok", clock
        assert clock.offset_s == pytest.approx(start_s - STARTS["cam00"], abs=2e-4)
    assert offsets.clocks["cam01"].sigma_s == pytest.approx(TRAVEL_SIGMA_S, rel=0.1)
    assert offsets.start_s is not None and 0.72 <= offsets.start_s < 0.76
    assert any("sound travels" in note for note in offsets.notes)
    write_offsets(tmp_path / "audio.json", offsets)
    assert read_offsets(tmp_path / "audio.json") == offsets


def test_held_out_camera_changes_no_input(films: dict[str, Path]) -> None:
    inputs = ["cam00", "cam01", "cam02"]
    without, with_one = listen(films, inputs, []), listen(films, inputs, ["cam03"])
    assert all(with_one.clocks[name] == without.clocks[name] for name in inputs)
    assert with_one.start_s == without.start_s


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("foreign", "fits none of 2 other cameras"),
        ("silent", "silent"),
        ("clipped", "clipped all over"),
        ("mute", "no sound"),
        ("copy", "same recording as cam00"),
        ("dubbed", "same recording as cam01"),
    ],
)
def test_bad_camera_is_left_out_with_its_reason(films: dict[str, Path], name: str, reason: str) -> None:
    for inputs, heldout in ((["cam00", "cam01", name], []), (["cam00", "cam01"], [name])):
        offsets = listen(films, inputs, heldout)
        assert reason in offsets.clocks[name].status
        assert offsets.clocks[name].score == 0
        assert offsets.clocks["cam01"].offset_s == pytest.approx(0.72, abs=2e-4)


def test_reference_without_sound_is_replaced_and_said(films: dict[str, Path]) -> None:
    offsets = listen(films, ["mute", "cam01", "cam02"], [])
    assert offsets.reference == "cam01"
    assert offsets.clocks["cam02"].offset_s == pytest.approx(-1.32, abs=2e-4)
    assert any("relative to cam01" in note and "mute" in note for note in offsets.notes)


@pytest.fixture(scope="module")
def tap(films: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of three pictures, with enough sound to be placed."""
    path = tmp_path_factory.mktemp("tap") / "tap.json"
    document = json.loads(films["dubbed"].read_text())
    times = {"num_source_frames": 3, "pts_s": [0.0, 1 / FPS, 2 / FPS], "sha256": "another"}
    path.write_text(json.dumps(document | {"camera": "tap"} | times))
    return path


def test_film_of_three_frames_is_left_out_and_the_scene_begins_as_without(
    films: dict[str, Path], tap: Path
) -> None:
    inputs = ["cam00", "cam01", "cam02"]
    without = listen(films, inputs, ["cam03"])
    for some in (["tap", *inputs], [*inputs, "tap"]):
        found = listen(films | {"tap": tap}, some, ["cam03"])
        assert found.clocks["tap"].status.startswith(TOO_SHORT)
        assert {name: found.clocks[name] for name in STARTS} == dict(without.clocks)
        assert (found.start_s, found.reference) == (without.start_s, "cam00")
    held_out = listen(films | {"tap": tap}, inputs, ["cam03", "tap"])
    assert held_out.clocks["tap"].status.startswith(TOO_SHORT) and held_out.start_s == without.start_s


def test_film_of_three_frames_is_no_reference_where_nobody_has_sound(
    films: dict[str, Path], tap: Path
) -> None:
    offsets = listen(films | {"tap": tap}, ["tap", "mute", "silent"], [])
    assert offsets.reference == "mute"


def test_no_camera_can_be_placed(films: dict[str, Path]) -> None:
    offsets = listen(films, ["cam00", "foreign"], ["mute"])
    assert offsets.start_s is None
    assert all(clock.status != "ok" for clock in offsets.clocks.values())
    nobody = listen(films, ["mute", "silent"], [])
    assert nobody.reference == "mute" and nobody.pairs == ()


def test_films_that_overlap_too_little_leave_no_start(films: dict[str, Path]) -> None:
    offsets = listen(films, ["cam00", "cam01"], [], num_frames=110)
    assert offsets.start_s is None and "110 frames" in offsets.notes[-1]
    assert offsets.clocks["cam01"].status == "ok"


def test_missing_ingest_file_is_named(films: dict[str, Path]) -> None:
    with pytest.raises(InputError, match="cam01"):
        run_listen([films["cam00"]], ["cam00", "cam01"], [], FPS, 30, AlignOptions())


def test_evidence_is_a_picture_and_the_same_each_time(films: dict[str, Path]) -> None:
    names = ["cam00", "cam01", "foreign", "mute"]
    sounds, status = read_sounds([films[name] for name in names])
    matches = compare_sounds(sounds, names, [], AlignOptions())
    offsets = solve_by_sound([match.delay for match in matches], status, names, [])
    image = draw_evidence(offsets, matches)
    assert image.dtype == np.uint8 and image.shape[2] == 3 and image.std() > 5
    assert np.array_equal(image, draw_evidence(offsets, matches))
    assert draw_evidence(offsets, []).shape[0] < image.shape[0]


@pytest.mark.skipif(not (DEMO / "phones").is_dir(), reason="the demo's phones are not made yet")
def test_demo_phones_within_two_milliseconds(tmp_path: Path) -> None:
    truth = describe_phones(DemoOptions())
    names = sorted(path.stem for path in (DEMO / "phones").glob("*.mp4"))
    paths = [ingest(tmp_path, name, DEMO / "phones" / f"{name}.mp4") for name in names]
    offsets, _ = run_listen(paths, names[:-2], names[-2:], FPS, 30, AlignOptions())
    frames = {name: truth["phones"][name]["frames"][20] for name in names}
    centers = {name: -np.transpose(frame["R"]) @ np.array(frame["t"]) for name, frame in frames.items()}
    pairs = correct_sound_travel(offsets.pairs, centers, np.array(truth["clap_position"]))
    corrected = solve_by_sound(pairs, dict.fromkeys(names, "ok"), names[:-2], names[-2:])
    for name in names:
        true_s = truth["phones"][name]["start_time_s"] - truth["phones"][names[0]]["start_time_s"]
        assert corrected.clocks[name].offset_s == pytest.approx(true_s, abs=2e-3)
        assert offsets.clocks[name].offset_s == pytest.approx(true_s, abs=2 * TRAVEL_SIGMA_S)
