"""Fused depth and colour against truth: `python -m benches.fused_depth --event DIR ... --output DIR`.

DIR is an event with true cameras and synchronised frames, in one of two forms: cameras.json and
frames/CAM/000000.png (the demo, whose held-out cameras are named by --heldout), or
inputs_frames/cameras.json, inputs_frames/CAM and truth/heldout_cameras.json, truth/heldout/CAM. Both have
truth/depth/CAM/000000.npz with `z` and truth/labels/CAM. Pairs are rectified and matched by the library;
the disparities are kept in --output/DIR/disparity and taken from there the next time.

Writes fused_depth.csv, a row per setting, view, region and estimate, and with --pictures a sheet per view
and frame: truth, consensus, its error (red too near, blue too far, black blank), the same of the closest.
`grown_px` and `shrunk_px`: pixels on the wrong side of the true silhouette of what moves, per pixel of its
length, within reach of it. Estimate `true depth` is the truth under the same colours.
"""

import argparse
import dataclasses
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd import cli, io
from fourd.camera import Camera, CameraTrack, camera_from_dict
from fourd.fuse import ESTIMATES, FusedView, FuseOptions, PairFrame, fuse_view
from fourd.fuse.cpu import CpuBackend
from fourd.fuse.files import read_pair_frame
from fourd.fuse.geometry import make_sources
from fourd.image import tile_images
from fourd.metrics import psnr_from_mse, squared_error
from fourd.stereo.disparity import StereoOptions, make_matcher, match_pair
from fourd.stereo.files import add_disparity_frame, disparity_meta
from fourd.stereo.rectify import STATUS_OK, RectifyOptions, rectify_tracks

FRAMES = (0, 15, 29)
# The workflow takes depths from sparse points: half the distance of the nearest, and no end.
NEAR_MARGIN = 0.75
REACH_PX = 6
# A silhouette is where the surface behind is farther by this share.
STEP = 0.05
# An input camera sees a point of the target if its own true depth there differs by no more than this share.
SAME_SURFACE = 0.02
TRUTH = "true depth"
SWEEP = (
    {},
    *({"min_pairs": k} for k in (2, 4)),
    *({"min_pairs": 2, "max_front": f} for f in (0.3, 0.6)),
    {"min_cameras": 4},
    *({"tolerance": t} for t in (1.5, 2.0, 4.5)),
    *({"footprint": f} for f in (0.5, 0.8)),
    *({"num_sources": n} for n in (1, 2, 3)),
)
COLUMNS = (
    "event", "view", "region", "estimate", "tolerance", "min_pairs", "min_cameras", "max_front", "footprint",
    "num_sources", "covered", "within_half_percent", "within_1_percent", "within_2_percent", "psnr_db",
    "grown_px", "shrunk_px", "error", "seconds", "cpu_seconds", "peak_rss_mb",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class View:
    """A held-out camera at one frame. depth: (H, W) z, inf = sky;  labels: (H, W), 0 static;
    counts: (H, W) bool, False on see-through glass."""

    camera: Camera
    image: np.ndarray
    depth: np.ndarray
    labels: np.ndarray
    counts: np.ndarray


@dataclasses.dataclass(frozen=True)
class Event:
    """cameras, images, true depths: by name, then by frame;  views: held-out name -> frame -> View."""

    name: str
    cameras: dict[str, dict[int, Camera]]
    images: dict[str, dict[int, np.ndarray]]
    depths: dict[str, dict[int, np.ndarray]]
    views: dict[str, dict[int, View]]
    near: float


def read_event(folder: Path, heldout: Sequence[str]) -> Event:
    """Either form of an event. Raises InputError for files that are missing."""
    inputs = folder / "inputs_frames"
    if inputs.exists():
        document = io.read_json(inputs / "cameras.json")
        held = io.read_json(folder / "truth" / "heldout_cameras.json")
        folders = {name: inputs / name for name in document["cameras"]}
        folders |= {name: folder / "truth" / "heldout" / name for name in held["cameras"]}
        size = held["width"], held["height"]
        entries = {k: v["frames"] for k, v in (document["cameras"] | held["cameras"]).items()}
        names = list(held["cameras"])
    else:
        document = io.read_json(folder / "cameras.json")["cameras"]
        folders = {name: folder / "frames" / name for name in document}
        entries = {name: camera["frames"] for name, camera in document.items()}
        size = tuple(next(iter(document.values()))["size"])
        names = list(heldout)
    cameras = {n: {f: camera_from_dict(e[f], size, n) for f in FRAMES} for n, e in entries.items()}
    images = {n: {f: io.read_image(path / f"{f:06d}.png") for f in FRAMES} for n, path in folders.items()}
    scene = io.read_json(folder / "truth" / "scene.json")
    views = {
        n: {f: read_view(folder / "truth", scene, n, f, cameras[n][f], images[n][f]) for f in FRAMES}
        for n in names
    }
    near = min(float(view.depth.min()) for frames in views.values() for view in frames.values())
    kept = [n for n in entries if n not in names]
    depths = {n: {f: read_depth(folder / "truth", n, f) for f in FRAMES} for n in kept}
    return Event(
        folder.name,
        {n: cameras[n] for n in kept},
        {n: images[n] for n in kept},
        depths,
        views,
        near * NEAR_MARGIN,
    )


def read_depth(truth: Path, name: str, frame: int) -> np.ndarray:
    with np.load(truth / "depth" / name / f"{frame:06d}.npz") as archive:
        return archive["z"].astype(np.float64)


def read_view(truth: Path, scene: dict, name: str, frame: int, camera: Camera, image: np.ndarray) -> View:
    depth = read_depth(truth, name, frame)
    labels = io.read_image(truth / "labels" / name / f"{frame:06d}.png")[..., 0]
    counts = np.ones(depth.shape, np.uint8)
    if "glass_pane" in scene:
        pane = scene["glass_pane"]
        angle, half = np.deg2rad(pane["rotz_deg"]), pane["w"] / 2
        along = half * np.array([np.cos(angle), np.sin(angle), 0.0])
        bottom, up = np.array(pane["bottom_centre"]), np.array([0.0, 0.0, pane["h"]])
        corners = np.array([bottom - along, bottom + along, bottom + along + up, bottom - along + up])
        pixels, z = camera.project(corners)
        if (z > 0).all():
            cv2.fillConvexPoly(counts, np.rint(pixels).astype(np.int32), 0)
    return View(camera, image, depth, labels, counts > 0)


def match_event(event: Event, folder: Path) -> dict[int, list[PairFrame]]:
    """Frame -> pairs, from the files in a folder, which are made where they are missing."""
    matcher, options = make_matcher(StereoOptions()), StereoOptions()
    found: dict[int, list[PairFrame]] = {frame: [] for frame in FRAMES}
    names = list(event.cameras)
    for i, left in enumerate(names):
        for right in names[i + 1 :]:
            for frame in FRAMES:
                path = folder / f"{left}-{right}" / f"{frame:06d}.npz"
                if not path.exists():
                    _match(event, left, right, frame, matcher, options, path)
                archive = io.Archive(path)
                if archive.meta["status"] == STATUS_OK:
                    found[frame].append(read_pair_frame(archive, frame))
                archive.close()
    return found


def _match(
    event: Event, left: str, right: str, frame: int, matcher: Any, options: StereoOptions, path: Path
) -> None:
    cameras = event.cameras[left][frame], event.cameras[right][frame]
    tracks = [CameraTrack(n, (c,), event.near, np.inf) for n, c in zip((left, right), cameras, strict=True)]
    pair = rectify_tracks(tracks[0], tracks[1], RectifyOptions())
    path.parent.mkdir(parents=True, exist_ok=True)
    with io.ArchiveWriter(path, disparity_meta(pair, options.sigma_px)) as writer:
        if pair.status == STATUS_OK:
            images = event.images[left][frame], event.images[right][frame]
            found = match_pair(pair.at(0), cameras, images, matcher, options)
            add_disparity_frame(writer, frame, found)


def fuse(event: Event, name: str, frame: int, pairs: list[PairFrame], options: FuseOptions) -> FusedView:
    images = {n: frames[frame] for n, frames in event.images.items()}
    cameras = {n: frames[frame] for n, frames in event.cameras.items()}
    return fuse_view(event.views[name][frame].camera, pairs, images, cameras, options)


def colour_truth(event: Event, name: str, frame: int, options: FuseOptions) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) true depth where an input camera sees the same point, else NaN, and its (H, W, 3) colours."""
    view = event.views[name][frame]
    height, width = view.depth.shape
    y, x = np.mgrid[:height, :width].astype(np.float64)
    known = np.isfinite(view.depth)
    points = view.camera.unproject(np.stack([x, y], axis=-1), np.where(known, view.depth, 1.0))
    mask = np.zeros((4, height, width), np.uint64)
    for bit, (camera, depth) in enumerate(
        (event.cameras[n][frame], event.depths[n][frame]) for n in event.cameras
    ):
        pixels, z = camera.project(points)
        u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)
        there = cv2.remap(depth.astype(np.float32), u, v, cv2.INTER_NEAREST, borderValue=(-1.0,))
        seen = known & (z > 0) & (np.abs(there - z) < SAME_SURFACE * z)
        mask[0] |= seen.astype(np.uint64) << np.uint64(bit)
    chosen = np.full(mask.shape, -1, np.float32)
    chosen[0] = np.where(mask[0] > 0, 1 / view.depth, -1)
    images = {n: frames[frame] for n, frames in event.images.items()}
    sources = make_sources(view.camera, {n: frames[frame] for n, frames in event.cameras.items()}, images)
    rgb, _ = CpuBackend(sources, options, (width, height), 1, height).colours(chosen, mask, 0)
    return np.where(mask[0] > 0, view.depth, np.nan), rgb[0].copy()


def silhouette_errors(depth: np.ndarray, view: View) -> tuple[float, float, int]:
    """Pixels grown and shrunk across the silhouette of what moves, and its length in pixels.

    depth: (H, W) fused, NaN = blank. A pixel counts on the wrong side where its depth is nearer to that
    of the nearest pixel across the silhouette than to its own, and the two differ by more than STEP.
    """
    moving = view.labels > 0
    totals, length = [0.0, 0.0], 0
    for side, inside in enumerate((~moving, moving)):
        across, depth_across = _nearest(~inside, view.depth)
        own, other = 1 / view.depth, 1 / depth_across
        is_step = (other > own * (1 + STEP)) if side == 0 else (own > other * (1 + STEP))
        band = inside & view.counts & (across <= REACH_PX) & is_step
        inverse = 1 / depth
        wrong = band & (np.abs(inverse - other) < np.abs(inverse - own))
        totals[side] += float(wrong.sum())
        if side:
            length = int((band & (across <= 1)).sum())
    return totals[0], totals[1], length


def _nearest(mask: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance to the nearest pixel of a mask, px, and the depth there."""
    distance, found = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    labels = np.asarray(found, np.int64)
    lookup = np.ones(int(labels.max()) + 1)
    lookup[labels[mask]] = depth[mask]
    return np.asarray(distance), lookup[labels]


class Score:
    """Sums over the frames of one view, region and estimate."""

    def __init__(self) -> None:
        self.pixels = self.covered = self.squared = self.error = 0.0
        self.within = np.zeros(3)

    def add(self, depth: np.ndarray, rgb: np.ndarray, view: View, region: np.ndarray) -> None:
        region = region & view.counts
        known = region & np.isfinite(depth)
        with np.errstate(invalid="ignore"):
            error = np.abs(depth / view.depth - 1)[known]
        # Sky is at infinity: any depth there is wrong.
        self.pixels += region.sum()
        self.covered += known.sum()
        self.within += [(error < bound).sum() for bound in (0.005, 0.01, 0.02)]
        self.error += np.minimum(error, 0.1).sum()
        self.squared += squared_error(rgb, view.image)[known].sum()

    def row(self) -> dict[str, str]:
        shares = 100 * self.within / max(self.covered, 1)
        return {
            "covered": f"{100 * self.covered / self.pixels:.2f}",
            "within_half_percent": f"{shares[0]:.2f}",
            "within_1_percent": f"{shares[1]:.2f}",
            "within_2_percent": f"{shares[2]:.2f}",
            "error": f"{self.error / max(self.covered, 1):.5f}",
            "psnr_db": f"{psnr_from_mse(self.squared / max(self.covered, 1)):.2f}",
        }


def measure(event: Event, name: str, pairs: dict[int, list[PairFrame]], options: FuseOptions) -> list[dict]:
    """Rows of one held-out view, over all frames."""
    estimates = (*ESTIMATES, TRUTH)
    scores = {(region, e): Score() for region in ("all", "dynamic") for e in estimates}
    edges: dict[str, np.ndarray] = {e: np.zeros(3) for e in estimates}
    start, cpu_start = time.monotonic(), time.process_time()
    results = {frame: fuse(event, name, frame, pairs[frame], options) for frame in FRAMES}
    cost = {
        "seconds": f"{(time.monotonic() - start) / len(FRAMES):.3f}",
        "cpu_seconds": f"{(time.process_time() - cpu_start) / len(FRAMES):.3f}",
        "peak_rss_mb": f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
    }
    for frame, fused in results.items():
        view = event.views[name][frame]
        truth = colour_truth(event, name, frame, options)
        for e in estimates:
            depth, rgb = truth if e == TRUTH else (fused.depths[e].astype(np.float64), fused.rgb[e])
            edges[e] += silhouette_errors(depth, view)
            for region, mask in (("all", np.ones(depth.shape, bool)), ("dynamic", view.labels > 0)):
                scores[region, e].add(depth, rgb, view, mask)
    rows = []
    for (region, e), score in scores.items():
        grown, shrunk, length = edges[e]
        row = {"event": event.name, "view": name, "region": region, "estimate": e}
        row |= {k: v for k, v in dataclasses.asdict(options).items() if k in COLUMNS} | score.row() | cost
        if region == "dynamic":
            row |= {"grown_px": f"{grown / length:.3f}", "shrunk_px": f"{shrunk / length:.3f}"}
        rows.append(row)
    return rows


def draw(event: Event, name: str, frame: int, fused: FusedView) -> np.ndarray:
    """What the module's docstring calls a sheet."""
    view = event.views[name][frame]
    rows = [[view.image], [np.repeat((view.labels * 80)[..., None], 3, axis=2).astype(np.uint8)]]
    near, far = np.array([255.0, 0, 0]), np.array([0, 0, 255.0])
    for row, e in zip(rows, ("consensus", "closest"), strict=True):
        error = np.maximum(fused.depths[e], 1e-9) / view.depth - 1
        share = np.clip(np.abs(error) / 0.05, 0, 1)[..., None]
        colour = np.where((error < 0)[..., None], near, far) * share + 255 * (1 - share)
        colour[~np.isfinite(fused.depths[e])] = 0
        row += [fused.rgb[e], np.nan_to_num(colour).astype(np.uint8)]
    return tile_images(rows)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--event", type=Path, nargs="+", required=True)
    parser.add_argument("--heldout", nargs="*", default=["cam02", "cam05"])
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--pictures", action="store_true")
    parser.add_argument("--sweep", action="store_true", help="other settings too")
    cli.add_options(parser, FuseOptions)
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    base = cli.options_from_args(FuseOptions, args)
    settings = [dataclasses.replace(base, **change) for change in (SWEEP if args.sweep else SWEEP[:1])]
    rows: list[dict] = []
    for folder in args.event:
        event = read_event(folder, args.heldout)
        pairs = match_event(event, args.output / event.name / "disparity")
        for name in event.views:
            for options in settings:
                found = measure(event, name, pairs, options)
                rows += found
                kept = [row for row in found if options is settings[0] or row["estimate"] == "consensus"]
                for row in kept:
                    print(*(row.get(column, "") for column in COLUMNS), sep=" ", flush=True)
            for frame in FRAMES if args.pictures else ():
                sheet = draw(event, name, frame, fuse(event, name, frame, pairs[frame], base))
                io.write_png(args.output / event.name / f"{name}-{frame:06d}.png", sheet)
    io.write_csv(args.output / "fused_depth.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
