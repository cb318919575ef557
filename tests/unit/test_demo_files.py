import dataclasses
import json
from pathlib import Path

import av
import numpy as np
import pytest
from scipy.signal import correlate

from fourd.camera import tracks_from_dict
from fourd.cli import run_stage
from fourd.demo import (
    DemoOptions,
    FrozenScene,
    camera_at,
    camera_names,
    camera_tracks,
    clip_times,
    orbit_cameras,
)
from fourd.demo.__main__ import main
from fourd.demo.figures import BALL, FIGURE2
from fourd.demo.phones import CLAP_POSITION, SAMPLE_RATE, SOUND_M_S, clap_times, make_phone, record_audio
from fourd.io import Archive, atomic_folder, read_image, read_json

TINY = DemoOptions(num_cameras=4, num_frames=6, width=96, height=54)
TINY_FLAGS = ["--num-cameras", "4", "--num-frames", "6", "--width", "96", "--height", "54"]


@pytest.fixture(scope="module")
def phone_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("phones") / "cam01.mp4"
    main(["phones", "--name", "cam01", "--output", str(path), *TINY_FLAGS])
    return path


def test_phone_file_has_its_frames_and_times(phone_file: Path) -> None:
    phone = make_phone("cam01", TINY)
    with av.open(str(phone_file)) as container:
        frames = list(container.decode(video=0))
    assert len(frames) == phone.num_frames
    stamps = np.array([float(f.pts * f.time_base) for f in frames])
    np.testing.assert_allclose(stamps, np.arange(phone.num_frames) / phone.fps, atol=2e-5)
    for index in (0, phone.num_frames - 1):
        time_s = float(phone.frame_times[index])
        truth = FrozenScene(time_s, TINY).render(camera_at("cam01", time_s, TINY))[0].astype(float)
        error = frames[index].to_ndarray(format="rgb24") - truth
        # Colours survive the encoder: no shift of range or matrix (subsampled chroma costs the most).
        assert np.abs(error.mean(axis=(0, 1))).max() < 3 and np.sqrt(np.mean(error**2)) < 14


def test_phones_cover_the_clip_on_unlike_clocks() -> None:
    options = DemoOptions()
    phones = [make_phone(name, options) for name in camera_names(options)]
    for phone in phones:
        assert phone.start_time_s < 0 and phone.frame_times[-1] > clip_times(options)[-1]
    assert len({phone.start_time_s for phone in phones}) == 9
    assert {phone.fps for phone in phones} == {25.0, 30.0}
    parts = np.array([-phone.start_time_s * 30 % 1 for phone in phones])
    assert (np.minimum(parts, 1 - parts) > 0.1).sum() == 4


def _delay_s(a: np.ndarray, b: np.ndarray) -> float:
    """How much later the same sound comes in b than in a, by plain cross-correlation."""
    return (np.argmax(correlate(b, a, "full")) - (len(a) - 1)) / SAMPLE_RATE


def test_audio_delays_are_clock_offset_plus_travel_of_sound() -> None:
    options = DemoOptions()
    heard = {name: record_audio(make_phone(name, options), options) for name in ("cam00", "cam03", "cam08")}
    for a, b in (("cam00", "cam03"), ("cam03", "cam08")):
        distance = [np.linalg.norm(camera_at(n, 0.5, options).center - CLAP_POSITION) for n in (a, b)]
        start = [make_phone(n, options).start_time_s for n in (a, b)]
        wanted = start[0] - start[1] + (distance[1] - distance[0]) / SOUND_M_S
        assert _delay_s(heard[a], heard[b]) == pytest.approx(wanted, abs=0.002)
    assert all(0.05 < np.abs(x).max() < 1 for x in heard.values())
    inside = clap_times(options)
    assert ((inside > 0) & (inside < 1)).sum() >= 2


def test_sound_in_the_file_is_in_step_with_its_pictures(phone_file: Path) -> None:
    with av.open(str(phone_file)) as container:
        frames = list(container.decode(audio=0))
    decoded = np.concatenate([f.to_ndarray()[0] for f in frames])
    start = float(frames[0].pts * frames[0].time_base)
    wanted = record_audio(make_phone("cam01", TINY), TINY)
    assert frames[0].sample_rate == SAMPLE_RATE
    assert start + _delay_s(wanted, decoded) == pytest.approx(0, abs=0.002)


def test_camera_command_writes_a_atomic_folder(tmp_path: Path) -> None:
    main(["camera", "--name", "cam01", "--output", str(tmp_path / "cam01"), *TINY_FLAGS])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cam01"]
    files = sorted((tmp_path / "cam01").iterdir())
    assert [p.name for p in files] == [f"{k:06d}.png" for k in range(6)]
    time_s = float(clip_times(TINY)[5])
    truth = FrozenScene(time_s, TINY).render(camera_at("cam01", time_s, TINY))[0]
    assert np.array_equal(read_image(files[5]), truth)


def test_interrupted_folder_is_never_taken_for_a_whole_one(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "cam00") as folder:
        (folder / "000000.png").write_bytes(b"half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_cameras_file_is_read_back_exactly(tmp_path: Path) -> None:
    main(["cameras", "--output", str(tmp_path / "cameras.json"), *TINY_FLAGS])
    document = read_json(tmp_path / "cameras.json")
    assert document["schema_version"] == 1 and document["fps"] == 30
    tracks = tracks_from_dict(document["cameras"], "cameras.json")
    for name, track in camera_tracks(TINY).items():
        assert tracks[name].size == (96, 54)
        for got, wanted in zip(tracks[name].cameras, track.cameras, strict=True):
            assert np.array_equal(got.R, wanted.R) and np.array_equal(got.t, wanted.t)


def test_truth_command_writes_the_parts_asked_for(tmp_path: Path) -> None:
    flags = [*TINY_FLAGS, "--num-orbit-views", "3"]
    main(["truth", "--output", str(tmp_path), "--frames", "2", "--without", "ball", *flags])
    labels = read_image(tmp_path / "labels" / "cam01" / "000002.png")
    assert labels.max() == FIGURE2
    archive = Archive(tmp_path / "depth" / "cam03" / "000002.npz")
    time_s = float(clip_times(TINY)[2])
    wanted = FrozenScene(time_s, TINY, (BALL,)).trace(camera_at("cam03", time_s, TINY))[0]
    assert archive["z"].dtype == np.float32 and np.array_equal(archive["z"], wanted)
    assert not (tmp_path / "depth" / "cam00" / "000000.npz").exists()
    assert len(list((tmp_path / "orbit").glob("*.png"))) == 3
    orbit = read_json(tmp_path / "orbit_cameras.json")
    np.testing.assert_array_equal(
        orbit["frames"][1]["R"], orbit_cameras(dataclasses.replace(TINY, num_orbit_views=3))[1].R
    )
    phones = json.loads((tmp_path / "phones.json").read_text())
    phone = make_phone("cam03", TINY)
    assert phones["phones"]["cam03"]["start_time_s"] == phone.start_time_s
    assert len(phones["phones"]["cam03"]["frames"]) == phone.num_frames
    assert read_json(tmp_path / "scene.json")["labels"]["figure2"] == FIGURE2


def test_only_some_parts_of_the_truth(tmp_path: Path) -> None:
    main(["truth", "--output", str(tmp_path), "--only", "scene", *TINY_FLAGS])
    assert [p.name for p in tmp_path.iterdir()] == ["scene.json"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["camera", "--name", "cam09"], "cam00..cam03"),
        (["camera", "--name", "cam00", "--without", "dog"], "figure1, figure2, ball"),
        (["truth", "--only", "colours"], "phones, depth, labels, orbit, scene"),
        (["truth", "--frames", "6"], "0..5"),
    ],
)
def test_unusable_input_is_one_sentence(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out"
    assert run_stage(main, [*arguments, "--output", str(output), *TINY_FLAGS]) == 2
    assert message in capsys.readouterr().err
    assert not output.exists()
