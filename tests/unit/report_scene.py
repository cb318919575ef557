"""A small finished scene for tests of the report: real files of all stages, two inputs and one held out."""

from pathlib import Path

import numpy as np

from fourd import io, views
from fourd.camera import Camera, CameraTrack
from fourd.geometry import look_at
from fourd.sfm import SceneCameras, write_cameras
from fourd.stereo.files import encode_disparity
from tests.films import put_on_clock

SIZE = (96, 64)
NUM_FRAMES = 4
NAMES = ("cam00", "cam01", "cam02")
HELDOUT = "cam01"
CHUNK = "000000-000003"
REFUSAL = "the cameras see the scene <62> degrees apart, more than 50"


def picture(seed: int) -> np.ndarray:
    """(H, W, 3) uint8 coloured blocks."""
    blocks = np.random.default_rng(seed).integers(0, 256, (8, 12, 3), np.uint8)
    return np.kron(blocks, np.ones((8, 8, 1), np.uint8))


def write_results(folder: Path, footage: Path) -> None:
    """All files below results/SCENE that the report reads, but for the scores."""
    tracks = {}
    for i, name in enumerate(NAMES):
        R, t = look_at(np.array([i - 1.0, -3.0, 1.5]), np.zeros(3), np.array([0, 0, 1.0]))
        K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
        tracks[name] = CameraTrack(name, (Camera(K, R, t, SIZE),), 1.0, 9.0)
        for frame in range(NUM_FRAMES):
            io.write_png(footage / name / f"{frame:06d}.png", picture(frame))
        put_on_clock(footage / name, name, folder / "align" / "cameras" / f"{name}.json", 30, NUM_FRAMES)
        film = io.read_json(folder / "align" / "cameras" / f"{name}.json")
        path = folder / "frames" / "cameras" / f"{name}.npz"
        with io.ArchiveWriter(path, {**film, "tone": None, "compensation": None}):
            pass
    inputs = tuple(name for name in NAMES if name != HELDOUT)
    up = np.array([0, 0, 1.0])
    given = dict.fromkeys(NAMES, "given")
    left_out = {"cam09": "too few <static> points"}
    scene = SceneCameras(30.0, NUM_FRAMES, inputs, (HELDOUT,), tracks, np.zeros(3), 1.0, up, given, left_out)
    write_cameras(folder / "sfm" / "cameras.json", scene)
    points = np.random.default_rng(0).normal(0, 1, (50, 3))
    with io.ArchiveWriter(folder / "sfm" / "points.npz") as writer:
        writer.add("points", points)
    view = views.physical_view(scene, HELDOUT, list(range(NUM_FRAMES)), None)
    views.write_view(folder / "views" / f"{HELDOUT}.json", view)
    _write_pair(folder)
    _write_estimates(folder)
    io.write_png(folder / "align" / "audio.png", picture(9))
    io.write_json(folder / "silhouettes" / "need.json", {"status": "stereo suffices"})
    rows = [{"epoch": e, "seconds": 2.0 * e, "reconstruction": 0.1 / (e + 1)} for e in range(3)]
    io.write_csv(folder / "composition" / "0" / "train.csv", list(rows[0]), rows)


def _write_pair(folder: Path) -> None:
    meta = {"left": "cam00", "right": "cam02", "angle_deg": 33.7, "guard": {"overlap": [0.9, 0.95]}}
    path = folder / "rectification" / "cam00-cam02.npz"
    with io.ArchiveWriter(path, {**meta, "status": "ok", "kind": "planar", "obstacle": None}):
        pass
    refused = {**meta, "right": "cam09", "status": REFUSAL, "kind": None, "obstacle": None}
    with io.ArchiveWriter(folder / "rectification" / "cam00-cam09.npz", refused):
        pass
    disparity = np.tile(np.linspace(1, 20, SIZE[0], dtype=np.float32), (SIZE[1], 1))
    disparity[:8] = np.nan
    with io.ArchiveWriter(
        folder / "disparity" / "cam00-cam02" / f"{CHUNK}.npz", {**meta, "status": "ok"}
    ) as writer:
        for frame in range(NUM_FRAMES):
            writer.add_frame(frame, left_disparity=encode_disparity(disparity))


def _write_estimates(folder: Path) -> None:
    valid = np.ones(SIZE[::-1], bool)
    valid[:10] = False
    status = {f"{frame:06d}": "ok" for frame in range(NUM_FRAMES)} | {"000002": "no pair has this frame"}
    with io.ArchiveWriter(
        folder / "foreground" / HELDOUT / f"{CHUNK}.npz", {"frame_status": status}
    ) as writer:
        for frame in range(NUM_FRAMES):
            arrays = {"consensus_rgb": picture(frame), "consensus_valid": valid}
            writer.add_frame(frame, **arrays, depth=np.where(valid, 3.0, np.nan).astype(np.float32))
    same = {str(frame): 0 for frame in range(NUM_FRAMES)}
    with io.ArchiveWriter(folder / "background" / HELDOUT / f"{CHUNK}.npz", {"same_as": same}) as writer:
        writer.add_frame(0, farthest_rgb=picture(7), farthest_valid=valid)
    rendered = folder / "render" / HELDOUT / CHUNK
    rows = []
    for frame in range(NUM_FRAMES):
        io.write_png(rendered / f"{frame:06d}.png", picture(frame) // 2)
        shares = {"hole_share": 0.01 * frame, "largest_hole_share": 0.0, "filled_share": 0.0}
        rows.append({"frame": frame, "level": 0, **shares, "reason": "holes are small"})
    io.write_csv(rendered / "holes.csv", list(rows[0]), rows)


def write_scores(
    path: Path,
    num_views: int = 1,
    num_frames: int = NUM_FRAMES,
    methods: tuple[str, ...] = ("inst", "ours", "another program"),
    metrics: tuple[str, ...] = ("mse", "psnr_db", "new_distance"),
    regions: tuple[str, ...] = ("full", "dynamic"),
) -> None:
    """A table of made-up values with names that no list knows; ours gets better frame by frame."""
    rng = np.random.default_rng(1)
    columns = ("view", "frame", "dt_s", "method", "region", "region_source", "metric", "value", "num_pixels")
    rows = (
        {
            "view": f"cam{view + 1:02d}",
            "frame": frame,
            "dt_s": "0.0",
            "method": method,
            "region": region,
            "region_source": "truth",
            "metric": metric,
            "value": 20.0 + frame if method == "ours" else repr(float(rng.normal(15, 1))),
            "num_pixels": 100,
        }
        for view in range(num_views)
        for frame in range(num_frames)
        for method in methods
        for region in regions
        for metric in metrics
    )
    io.write_csv(path, columns, rows)


def hold_out(folder: Path, num_views: int) -> None:
    """The scene with as many held-out cameras, cam01 and on; only the first one has results."""
    document = io.read_json(folder / "sfm" / "cameras.json")
    cameras = document["cameras"]
    document["heldout"] = [f"cam{view + 1:02d}" for view in range(num_views)]
    document["left_out"] = {}
    document["cameras"] = {name: cameras["cam01"] for name in document["heldout"]} | cameras
    document["inputs"] = [name for name in document["inputs"] if name not in document["heldout"]]
    io.write_json(folder / "sfm" / "cameras.json", document)


def write_benchmarks(folder: Path) -> None:
    """Times of three rules, the last of which the report does not know."""
    header = "s\th:m:s\tmax_rss\tmax_vms\tmax_uss\tmax_pss\tio_in\tio_out\tmean_load\tcpu_time\n"
    for name, seconds in (("render_frames/cam01/0", 2.0), ("fuse_foreground/cam01/0", 4.0), ("polish", 1.0)):
        path = folder / f"{name}.tsv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{header}{seconds}\t0:00:02\t100.0\t-\t-\t-\t0\t0\t90\t{seconds / 2}\n")
