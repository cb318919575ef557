"""Evidence for tests of methods and regions: a plane that faces a row of cameras."""

import dataclasses

import numpy as np

from fourd.baselines import Evidence, InputPicture
from fourd.baselines.nearest import FilmIndex, describe_image
from fourd.camera import Camera

SIZE = (96, 64)
K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
VIEW = Camera(K, np.eye(3), np.zeros(3), SIZE)
DEPTH = 3.0


def paint(points: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 colour of world points: smooth, so that resampling hardly changes it."""
    waves = np.stack(
        [np.sin(2 * points[..., 0]), np.cos(2 * points[..., 1]), np.sin(points[..., 0])], axis=-1
    )
    return np.floor(128 + 100 * waves).astype(np.uint8)


def pixel_grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)


def film(camera: Camera) -> np.ndarray:
    """What a camera that looks along z sees of the plane z = 3."""
    return paint(camera.unproject(pixel_grid(), np.full((SIZE[1], SIZE[0]), DEPTH)))


def input_camera(x: float) -> Camera:
    return dataclasses.replace(VIEW, t=np.array([-x, 0.0, 0.0]))


def make_evidence(
    near=None, far=None, filled=None, num_cameras=None, num_inputs=2, points=None, **changes
) -> Evidence:
    """Consensus and background on the plane; inputs 0.2 apart, on both sides of the view."""
    shape = (SIZE[1], SIZE[0])
    nothing, zeros = np.zeros(shape, bool), np.zeros(shape, np.uint8)
    depth, truth = np.full(shape, DEPTH, np.float32), film(VIEW)
    inputs = {}
    for i in range(num_inputs):
        camera = input_camera((-1) ** i * 0.2 * (i // 2 + 1))
        image = film(camera)
        inputs[f"cam{i}"] = InputPicture(image, np.ones(shape, bool), camera, describe_image(image))
    films = FilmIndex(
        [(name, 0) for name in inputs],
        np.stack([entry.feature for entry in inputs.values()]) if inputs else np.zeros((0, 1)),
        lambda name, frame: inputs[name].image,
        "",
    )
    evidence = Evidence(
        {
            "consensus_rgb": truth,
            "consensus_valid": nothing if near is None else near,
            "depth": depth,
            "num_cameras": zeros if num_cameras is None else num_cameras,
        },
        {
            "farthest_rgb": truth,
            "farthest_valid": ~nothing if far is None else far,
            "depth": depth,
            "filled": nothing if filled is None else filled,
        },
        truth,
        inputs,
        truth,
        VIEW,
        np.zeros((0, 3)) if points is None else points,
        films,
        describe_image(truth),
    )
    return dataclasses.replace(evidence, **changes)
