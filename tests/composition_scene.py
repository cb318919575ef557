"""A scene of two small cameras to train the composition on, and how tests train on it."""

import dataclasses

import numpy as np
import torch

from fourd import io
from fourd.camera import Camera, CameraTrack
from fourd.composition import CompositionOptions
from fourd.composition.__main__ import Sources, run
from fourd.sfm import SceneCameras, write_cameras
from tests.films import put_on_clock

SIZE = (32, 24)
FRAMES = (0, 1, 2)
CAMS = ("cam00", "cam01")
TINY = CompositionOptions(
    num_filters=(3, 3, 3),
    depth=1,
    epochs=2,
    crop=16,
    learning_rate=1e-3,
    warmup_steps=4,
    validation_samples=0,
    num_threads=1,
    checkpoint_s=1e9,
)


def smooth_image(seed):
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    return (128 + 80 * np.sin(x[..., None] / 4 + y[..., None] / 6 + phase)).astype(np.uint8)


def write_scene(folder):
    """Two cameras, three frames: the estimates are the truth with noise and blanks."""
    camera = Camera(np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]), np.eye(3), np.zeros(3), SIZE)
    rng = np.random.default_rng(0)
    frames = [{"frame": f, "scene_frame": f, **camera.to_dict()} for f in FRAMES]
    for number, cam in enumerate(CAMS):
        truth = [smooth_image(10 * number + f) for f in FRAMES]
        for f in FRAMES:
            io.write_png(folder / f"images/{cam}/{f:06d}.png", truth[f])
        put_on_clock(folder / f"images/{cam}", cam, folder / f"films/{cam}.json", 30, len(FRAMES))
        io.write_json(folder / f"views/{cam}.json", {"role": "input", "size": list(SIZE), "frames": frames})
        for kind, keys in (("foreground", ("consensus", "closest", "median", "farthest")),
                           ("background", ("farthest", "median"))):  # fmt: skip
            with io.ArchiveWriter(folder / f"{kind}/{cam}/000000-000002.npz", {"view": cam}) as writer:
                for f in FRAMES:
                    for key in keys:
                        noisy = np.clip(truth[f] + rng.normal(0, 25, truth[f].shape), 0, 255).astype(np.uint8)
                        valid = rng.random(truth[f].shape[:2]) < 0.7
                        noisy[~valid] = 0
                        writer.add_frame(f, **{f"{key}_rgb": noisy, f"{key}_valid": valid})
    tracks = {cam: CameraTrack(cam, (camera,), 0.5, 10.0) for cam in CAMS}
    scene = SceneCameras(30.0, 3, CAMS, (), tracks, np.zeros(3), 1.0, np.array([0, -1.0, 0]), {})
    write_cameras(folder / "sfm/cameras.json", scene)
    return Sources(
        tuple(folder / f"views/{cam}.json" for cam in CAMS),
        tuple(folder / f"foreground/{cam}/000000-000002.npz" for cam in CAMS),
        tuple(folder / f"background/{cam}/000000-000002.npz" for cam in CAMS),
        {cam: folder / f"films/{cam}.json" for cam in CAMS},
        folder / "sfm/cameras.json",
    )


def train_model(sources, folder, options=TINY, level=0, num_levels=1):
    outputs = folder / "model.pt", folder / "train.csv", folder / "validation.png"
    run(sources, level, num_levels, *outputs, options, "cpu")
    return torch.load(folder / "model.pt", weights_only=True)["state_dict"]


def are_equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def command_line(sources, folder, options):
    words = ["train", "--level", "0", "--num-levels", "1", "--device", "cpu"]
    words += ["--views", *map(str, sources.views), "--foreground", *map(str, sources.foreground)]
    words += ["--background", *map(str, sources.background), "--cameras", str(sources.cameras)]
    words += ["--films", *(f"{cam}={path}" for cam, path in sources.films.items())]
    words += ["--output-model", str(folder / "model.pt"), "--output-log", str(folder / "train.csv")]
    words += ["--output-picture", str(folder / "validation.png")]
    for key, value in dataclasses.asdict(options).items():
        values = value if isinstance(value, tuple) else ["none" if value is None else value]
        words += ["--" + key.replace("_", "-"), *map(str, values)]
    return words
