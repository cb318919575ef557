"""Small scenes with known answers for the tests of fusion and background."""

import dataclasses
from pathlib import Path

import numpy as np

from fourd.camera import Camera, CameraTrack, tracks_to_dict
from fourd.fuse import FuseOptions, PairFrame
from fourd.geometry import look_at
from fourd.io import Archive, ArchiveWriter, write_json, write_png
from fourd.stereo.files import encode_confidence, encode_disparity
from tests.films import put_on_clock

SIZE = (24, 18)
OPTIONS = FuseOptions()


def make_camera(x: float, y: float = 0.0, size: tuple[int, int] = SIZE, focal: float = 22.0) -> Camera:
    R, t = look_at(np.array([x, y, 0.0]), np.array([0.0, 0.0, 4.0]), np.array([0.0, -1.0, 0.0]))
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    return Camera(K, R, t, size)


def make_cameras(count: int = 4) -> dict[str, Camera]:
    return {f"cam{i:02d}": make_camera(0.5 * (i - (count - 1) / 2)) for i in range(count)}


def make_images(cameras: dict[str, Camera], seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {n: rng.integers(0, 256, (c.size[1], c.size[0], 3), dtype=np.uint8) for n, c in cameras.items()}


def rectify(cameras: dict[str, Camera], left: str, right: str) -> dict:
    a, b = cameras[left], cameras[right]
    x = (b.center - a.center) / np.linalg.norm(b.center - a.center)
    z = a.forward + b.forward
    z = (z - x * (z @ x)) / np.linalg.norm(z - x * (z @ x))
    R = np.stack([x, np.cross(z, x), z])
    K_left = a.K.copy()
    K_right = a.K.copy()
    K_right[0, 2] += 1.5
    return {
        "left": left, "right": right, "K_left": K_left, "K_right": K_right, "R_left": R, "R_right": R,
        "center_left": a.center, "center_right": b.center, "sigma_px": 0.25,
        "disparity_at_infinity": (float(K_left[0, 2] - K_right[0, 2]),) * 2,
        "inverse_depth_per_px": (float(1 / (K_left[0, 0] * np.linalg.norm(b.center - a.center))),) * 2,
    }  # fmt: skip


def pair_from_plane(cameras: dict[str, Camera], left: str, right: str, depth: float) -> PairFrame:
    """Exact disparities of the world plane z = depth."""
    geometry = rectify(cameras, left, right)
    width, height = SIZE
    maps = {}
    for side in ("left", "right"):
        K, center = geometry[f"K_{side}"], geometry[f"center_{side}"]
        y, x = np.mgrid[:height, :width].astype(np.float64)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T
        z = (depth - center[2]) / (rays @ geometry["R_left"])[..., 2]
        (zero, _), (per_px, _) = geometry["disparity_at_infinity"], geometry["inverse_depth_per_px"]
        maps[f"{side}_disparity"] = (1 / (z * per_px) + zero).astype(np.float32)
        maps[f"{side}_confidence"] = np.ones((height, width), np.float32)
    return PairFrame(**geometry, **maps)


def random_pair(cameras: dict[str, Camera], left: str, right: str, rng: np.random.Generator) -> PairFrame:
    """Two noisy surfaces, holes, garbage, points at and beyond infinity."""
    pair = pair_from_plane(cameras, left, right, 4.0)
    maps = {}
    for side in ("left", "right"):
        near = pair_from_plane(cameras, left, right, 2.5)
        disparity = getattr(pair, f"{side}_disparity").copy()
        block = np.s_[3:12, 5:14]
        disparity[block] = getattr(near, f"{side}_disparity")[block]
        disparity += rng.normal(0, 0.2, disparity.shape).astype(np.float32)
        kind = rng.integers(0, 12, disparity.shape)
        disparity[kind == 0] = np.nan
        disparity[kind == 1] = rng.uniform(-6, 12, (kind == 1).sum()).astype(np.float32)
        disparity[kind == 2] = np.float32(-1.5)
        maps[f"{side}_disparity"] = disparity
        maps[f"{side}_confidence"] = rng.choice(
            np.array([0, 0.25, 0.5, 1], np.float32), disparity.shape, p=[0.1, 0.3, 0.3, 0.3]
        )
    return dataclasses.replace(pair, **maps)


def all_pairs(cameras: dict[str, Camera], make, *args) -> list[PairFrame]:
    names = list(cameras)
    return [make(cameras, a, b, *args) for i, a in enumerate(names) for b in names[i + 1 :]]


def assert_equal_views(a, b, colour_tolerance: int = 0) -> None:
    for estimate in a.rgb:
        np.testing.assert_array_equal(a.depths[estimate], b.depths[estimate], err_msg=estimate)
        np.testing.assert_array_equal(a.valid[estimate], b.valid[estimate], err_msg=estimate)
        difference = np.abs(a.rgb[estimate].astype(int) - b.rgb[estimate].astype(int))
        assert difference.max(initial=0) <= colour_tolerance, estimate
    np.testing.assert_array_equal(a.support, b.support)
    np.testing.assert_array_equal(a.num_cameras, b.num_cameras)
    np.testing.assert_array_equal(a.source, b.source)
    np.testing.assert_array_equal(a.depth_source, b.depth_source)


def edge_cases(cameras: dict[str, Camera]) -> dict[str, list[PairFrame]]:
    """Inputs where choices are ties, or where there is little to choose from."""
    plane = pair_from_plane(cameras, "cam00", "cam01", 4.0)
    other = pair_from_plane(cameras, "cam01", "cam02", 4.0)
    blank = {f"{side}_disparity": np.full(SIZE[::-1], np.nan, np.float32) for side in ("left", "right")}
    infinite = {f"{side}_disparity": np.full(SIZE[::-1], -1.5, np.float32) for side in ("left", "right")}
    beyond = {f"{side}_disparity": np.full(SIZE[::-1], -9.0, np.float32) for side in ("left", "right")}
    close = {f"{side}_disparity": np.full(SIZE[::-1], 900.0, np.float32) for side in ("left", "right")}
    mixed = {f"{side}_disparity": np.full(SIZE[::-1], np.inf, np.float32) for side in ("left", "right")}
    return {
        "same pair four times": [plane] * 4,
        "one pair": [plane],
        "all invalid": [dataclasses.replace(plane, **blank)],
        "one of two invalid": [dataclasses.replace(plane, **blank), other],
        "at infinity": [dataclasses.replace(plane, **infinite), dataclasses.replace(other, **infinite)],
        "beyond infinity": [dataclasses.replace(plane, **beyond), other],
        "behind the target": [dataclasses.replace(plane, **close), other],
        "infinite disparity": [dataclasses.replace(plane, **mixed)],
    }


def write_scene(folder: Path, num_frames: int = 2) -> dict[str, Camera]:
    """A scene of three still cameras before a plane, as the stages before leave it."""
    cameras = make_cameras(3)
    tracks = {name: CameraTrack(name, (camera,), 1.0, 10.0) for name, camera in cameras.items()}
    document = {"fps": 30.0, "num_frames": num_frames, "world": {"scale": 1.0, "origin": [0, 0, 0]}}
    document |= {"up": [0, -1, 0], "inputs": list(cameras), "heldout": [], "cameras": tracks_to_dict(tracks)}
    write_json(folder / "cameras.json", document)
    target = make_camera(0.1)
    frames = [{"frame": i, "scene_frame": i, **target.to_dict()} for i in range(num_frames)]
    write_json(folder / "views" / "orbit.json", {"role": "virtual", "size": list(SIZE), "frames": frames})
    physical = [{**entry, **cameras["cam01"].to_dict()} for entry in frames]
    write_json(folder / "views" / "cam01.json", {"role": "input", "size": list(SIZE), "frames": physical})
    for i, name in enumerate(cameras):
        for frame in range(num_frames):
            image = make_images(cameras, seed=10 * frame + i)[name]
            write_png(folder / "frames" / name / f"{frame:06d}.png", image)
        put_on_clock(folder / "frames" / name, name, folder / "films" / name / f"{name}.json", 30, num_frames)
    for pair in all_pairs(cameras, pair_from_plane, 4.0):
        write_pair(folder / "disparity" / f"{pair.left}-{pair.right}.npz", pair, range(num_frames))
    return cameras


def write_pair(path: Path, pairs: PairFrame | list[PairFrame], frames, status: str = "ok") -> None:
    """A disparity file of one pair; a list has one entry per frame."""
    pair = pairs[0] if isinstance(pairs, list) else pairs
    meta = {"left": pair.left, "right": pair.right, "status": status, "sigma_px": pair.sigma_px}
    with ArchiveWriter(path, meta) as writer:
        for i, frame in enumerate(frames if status == "ok" else ()):
            pair = pairs[i] if isinstance(pairs, list) else pairs
            writer.add_frame(
                frame,
                left_disparity=encode_disparity(pair.left_disparity),
                right_disparity=encode_disparity(pair.right_disparity),
                left_confidence=encode_confidence(pair.left_confidence),
                right_confidence=encode_confidence(pair.right_confidence),
                K_left=pair.K_left, K_right=pair.K_right, R_left=pair.R_left, R_right=pair.R_right,
                center_left=pair.center_left, center_right=pair.center_right,
                baseline=np.linalg.norm(pair.center_right - pair.center_left),
                disparity_range=np.array([-4.0, 20.0]),
            )  # fmt: skip


def change_archive(path: Path, arrays: dict[str, np.ndarray | None], meta: dict | None = None) -> None:
    """Write an archive again with other arrays, or without those that are None, and other meta."""
    with Archive(path) as archive:
        names = [f"{frame:06d}/{key}" for frame in archive.frames() for key in archive.frame(frame)]
        kept = {name: archive[name] for name in names} | arrays
        document = archive.meta | (meta or {})
    with ArchiveWriter(path, document) as writer:
        for name, array in kept.items():
            if array is not None:
                writer.add(name, array)


def stage_words(folder: Path, view: str = "orbit", frames: str = "0 1") -> list[str]:
    words = f"--view-file {folder}/views/{view}.json --cameras {folder}/cameras.json --frames {frames}"
    disparities = [str(path) for path in sorted((folder / "disparity").glob("*.npz"))]
    films = [str(path) for path in sorted((folder / "films").glob("cam??/cam??.json"))]
    return [*words.split(), "--disparity", *disparities, "--films", *films]
