"""From phone files alone to one clock and known cameras, with every kind of film that cannot be used."""

import dataclasses
import shutil
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from fourd.align.clock import read_offsets
from fourd.audio import read_audio
from fourd.camera import camera_from_dict
from fourd.demo.options import DemoOptions, camera_names
from fourd.demo.phones import SAMPLE_RATE, write_phone_file
from fourd.demo.truth import describe_phones
from fourd.film_cameras import FilmCamera, read_film_cameras
from fourd.io import read_json
from fourd.sfm.cameras import read_cameras
from fourd.sfm.compare import align_similarity
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.recover import recover_cameras
from fourd.video import read_video_frames
from fourd.video.encode import SAME_BYTES
from tests.conftest import Workspace
from tests.unit.recover_films import film_of

EVENT = DemoOptions(num_cameras=5, num_frames=18, width=320, height=180, arc_deg=44, samples_per_axis=1)
GOOD = tuple(camera_names(EVENT))
HELDOUT = "cam02"
# Film -> what the reason for leaving it out must say.
BAD = {
    "other": "sound",
    "copy": "same recording as cam00",
    "single": "",
    "tap": "too short for the scene",
    "covered": "",
}


def write_film(path: Path, pictures: list[np.ndarray], sound: np.ndarray | None = None) -> None:
    """A film at 30 fps, with mono sound if there is any."""
    with av.open(str(path), "w") as container:
        video = container.add_stream("libx264", rate=30, options={"crf": "18", **SAME_BYTES})
        video.width, video.height, video.pix_fmt = pictures[0].shape[1], pictures[0].shape[0], "yuv420p"
        audio = None if sound is None else container.add_stream("aac", rate=SAMPLE_RATE, layout="mono")
        for index, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = index, Fraction(1, 30)
            container.mux(video.encode(frame))
        container.mux(video.encode(None))
        if audio is not None and sound is not None:
            for first in range(0, len(sound), 1024):
                block = av.AudioFrame.from_ndarray(
                    sound[None, first : first + 1024].astype(np.float32), format="fltp", layout="mono"
                )
                block.sample_rate, block.pts, block.time_base = SAMPLE_RATE, first, Fraction(1, SAMPLE_RATE)
                container.mux(audio.encode(block))
            container.mux(audio.encode(None))


def write_bad_films(folder: Path) -> None:
    pictures = [image for _, image in read_video_frames(folder / "cam00.mp4", range(20))]
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, pictures[0].shape, dtype=np.uint8) for _ in range(20)]
    write_film(folder / "other.mp4", noise, 0.2 * rng.standard_normal(SAMPLE_RATE))
    shutil.copy(folder / "cam00.mp4", folder / "copy.mp4")
    write_film(folder / "single.mp4", pictures[:1])
    # A mistaken tap, whose sound went on long enough to be placed.
    sound = read_audio(folder / "cam01.mp4")
    assert sound is not None and sound.sample_rate == SAMPLE_RATE
    write_film(folder / "tap.mp4", pictures[:3], sound.samples)
    write_film(folder / "covered.mp4", [np.full_like(pictures[0], 12)] * 20, np.zeros(SAMPLE_RATE))


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Five phones and five films that cannot be used, as far as the cameras of the scene."""
    workspace = Workspace(tmp_path_factory.mktemp("phones"))
    films = workspace.folder / "films"
    films.mkdir()
    for name in GOOD:
        write_phone_file(films / f"{name}.mp4", name, EVENT)
    write_bad_films(films)
    scene = {
        "fps": 30,
        "num_frames": EVENT.num_frames,
        "size": [320, 180],
        "cameras": {name: {"source": f"films/{name}.mp4"} for name in (*GOOD, *BAD)},
        "heldout": [HELDOUT],
        "settings": {"align_vision": {"use": "always"}},
    }
    workspace.write_scene("event", scene)
    workspace.write_config({"scene": "event"})
    targets = [f"results/event/frames/cameras/{name}.npz" for name in (*GOOD, *BAD)]
    result = workspace.snakemake("--cores", "2", "--show-failed-logs", *targets)
    assert result.returncode == 0, result.stdout[-6000:]
    return workspace


def results(workspace: Workspace) -> Path:
    return workspace.folder / "results" / "event"


def test_clocks_are_within_a_quarter_frame(finished: Workspace) -> None:
    clocks = read_offsets(results(finished) / "align" / "offsets.json").clocks
    truth = {name: phone["start_time_s"] for name, phone in describe_phones(EVENT)["phones"].items()}
    for name in GOOD:
        assert clocks[name].status == "ok"
        error_s = (clocks[name].offset_s - clocks["cam00"].offset_s) - (truth[name] - truth["cam00"])
        assert abs(error_s) < 0.25 / 30, (name, error_s * 30)
        assert clocks[name].sigma_s < 0.25 / 30


def check_cameras(films: Mapping[str, FilmCamera]) -> None:
    """All frames of the good films are where they were."""
    phones = describe_phones(EVENT)["phones"]
    found, true = [], []
    for name in GOOD:
        assert films[name].status == "ok"
        for frame in films[name].source_frames:
            camera = films[name].at(int(frame))
            assert camera is not None
            found.append(camera)
            true.append(camera_from_dict(phones[name]["frames"][int(frame)], camera.size, name))
    errors = align_similarity(found, true)
    assert np.median(errors.rotation_deg) < 0.12
    assert np.median(errors.center / errors.distance) < 0.002
    assert np.abs(errors.focal).max() < 0.005


def test_cameras_are_where_they_were(finished: Workspace) -> None:
    check_cameras(read_film_cameras(results(finished) / "sfm" / "film_cameras.json").cameras)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_little_noise_moves_no_camera(finished: Workspace, seed: int) -> None:
    """Noise of a grey level or two changes every corner and match, as another processor changes a few."""
    rng = np.random.default_rng(seed)
    films = {}
    for name in GOOD:
        count = len(describe_phones(EVENT)["phones"][name]["frames"])
        pictures = [
            image for _, image in read_video_frames(finished.folder / f"films/{name}.mp4", range(count))
        ]
        noisy = [image + np.rint(rng.normal(0, 1.5, image.shape)) for image in pictures]
        films[name] = film_of(name, [np.clip(image, 0, 255).astype(np.uint8) for image in noisy])
    check_cameras(recover_cameras(films, [HELDOUT], None, RecoverOptions()).cameras)


@pytest.mark.parametrize("name", BAD)
def test_films_that_cannot_be_used_are_left_out_with_the_reason(finished: Workspace, name: str) -> None:
    scene = read_cameras(results(finished) / "sfm" / "cameras.json")
    assert name in scene.left_out
    assert (
        BAD[name]
        in scene.left_out[name]
        + read_offsets(results(finished) / "align" / "offsets.json").clocks[name].status
    )
    assert scene.inputs == tuple(n for n in GOOD if n != HELDOUT)


def test_pictures_are_those_of_the_common_clock(finished: Workspace) -> None:
    """Every good film has a picture within half of its own frame for every frame of the scene."""
    for name in GOOD:
        document = read_json(results(finished) / "align" / "cameras" / f"{name}.json")
        assert len(document["dt_s"]) == EVENT.num_frames
        assert np.abs(document["dt_s"]).max() <= 0.5 / document["ingest"]["fps"] + 1e-6


def test_nothing_of_an_input_depends_on_a_held_out_film(finished: Workspace, tmp_path: Path) -> None:
    """With other pictures and other sound in the held-out film, all inputs come out the same, by a bit."""
    workspace = Workspace(tmp_path)
    shutil.copytree(finished.folder / "films", tmp_path / "films")
    write_phone_file(tmp_path / "films" / f"{HELDOUT}.mp4", HELDOUT, dataclasses.replace(EVENT, seed=11))
    shutil.copytree(finished.folder / "config", tmp_path / "config", dirs_exist_ok=True)
    targets = ["results/event/sfm/cameras.json", "results/event/frames/colour.json"]
    result = workspace.snakemake("--cores", "2", "--show-failed-logs", *targets)
    assert result.returncode == 0, result.stdout[-6000:]
    for file, key in (
        ("sfm/film_cameras.json", "cameras"),
        ("align/offsets.json", "cameras"),
        ("frames/colour.json", "cameras"),
        ("sfm/cameras.json", "cameras"),
    ):
        before = read_json(results(finished) / file)[key]
        after = read_json(results(workspace) / file)[key]
        for name in GOOD:
            assert name == HELDOUT or before[name] == after[name], (file, name)
