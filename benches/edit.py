"""Error and time of edits: masks through one film, and through all cameras and times of the demo event.

    python -m benches.edit --output DIR [--clips DIR] [--event DIR --scene NAME [--sweep grow_px ...]]

CLIPS holds JPEGImages/CLIP/*.jpg and Annotations/CLIP/*.png (0 = background) of every frame: each clip is
marked on its first frame only. EVENT is a folder in which `edit_all` has edited cam04 of the demo with its
true cameras (scene demo_known, `keep_gb` so large that disparities stay). Edits are marked by a box around a
figure on one frame; the truth is the event rendered again without it. Writes edit.csv: one row per clip, or
per edit and step, and a picture of each.
"""

import argparse
import contextlib
import dataclasses
import os
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd import cli, io
from fourd.camera import Camera
from fourd.demo.cameras import camera_at, clip_times
from fourd.demo.options import DemoOptions
from fourd.demo.render import FrozenScene
from fourd.edit import depths, films, masks
from fourd.edit.compose import OTHER_TIME, SAME_TIME
from fourd.edit.options import EditOptions
from fourd.edit.single import follow_mask
from fourd.edit.spec import Edit, Mark
from fourd.errors import InputError
from fourd.fuse.options import FuseOptions
from fourd.image import tile_images
from fourd.metrics import psnr
from fourd.render import RenderOptions
from fourd.sfm.cameras import SceneCameras, read_cameras

COLUMNS = (
    "experiment", "subject", "error", "jaccard", "boundary", "psnr_changed_db", "psnr_thing_db",
    "psnr_outside_db", "provenance_right", "flicker_ratio", "seconds", "cpu_seconds", "peak_rss_mb",
)  # fmt: skip
# Of the boundary measure, as a share of the diagonal (F. Perazzi et al., DAVIS, CVPR 2016).
BOUNDARY_SHARE = 0.008
CHANGED_LEVELS = 6
SAME_SURFACE = 0.03
EDITS = {
    "man": ("cam04", 5, (1,), "remove", 1),
    "woman": ("cam06", 10, (2,), "remove", 1),
    "behind_1": ("cam04", 5, (1,), "see_behind", 1),
    "behind_2": ("cam04", 5, (1, 2), "see_behind", 2),
}
VIEW = "cam04"
SWEEPS = {"grow_px": (0.0, 1.5, 3.0), "feather_px": (0.0, 1.0, 2.0), "num_times": (3, 6, 12)}
LABEL_OF_MARK = {"man": 1, "woman": 2, "behind_1": 1, "behind_2": 1}


def jaccard(mask: np.ndarray, truth: np.ndarray) -> float:
    """Intersection over union; 1 where both are empty."""
    union = (mask | truth).sum()
    return float((mask & truth).sum() / union) if union else 1.0


def boundary_score(mask: np.ndarray, truth: np.ndarray) -> float:
    """F-measure of the outlines, within a tolerance. Source: F. Perazzi et al., CVPR 2016, section 3."""
    radius = int(np.ceil(BOUNDARY_SHARE * np.hypot(*mask.shape)))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    edges = [
        m.astype(np.uint8) - cv2.erode(m.astype(np.uint8), np.ones((3, 3), np.uint8)) for m in (mask, truth)
    ]
    near = [cv2.dilate(edge, disc) > 0 for edge in edges]
    if not edges[0].any() or not edges[1].any():
        return float(edges[0].any() == edges[1].any())
    precision, recall = near[1][edges[0] > 0].mean(), near[0][edges[1] > 0].mean()
    return float(2 * precision * recall / max(precision + recall, 1e-9))


@contextlib.contextmanager
def measured(row: dict[str, Any]) -> Iterator[None]:
    """Put seconds, processor seconds and peak memory of a block into a row."""
    wall, cpu = time.monotonic(), time.process_time()
    yield
    row["seconds"], row["cpu_seconds"] = (
        round(time.monotonic() - wall, 2),
        round(time.process_time() - cpu, 2),
    )
    row["peak_rss_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def bench_clip(folder: Path, clip: str, output: Path) -> dict[str, Any]:
    """Follow the first mask of a clip. Error is 1 - (J + F) / 2, times are per frame."""
    paths = sorted((folder / "JPEGImages" / clip).glob("*.jpg"))
    truths = [io.read_image(folder / "Annotations" / clip / f"{p.stem}.png")[:, :, 0] > 0 for p in paths]
    images = [io.read_image(path) for path in paths]
    row: dict[str, Any] = {"experiment": "one film", "subject": clip}
    with measured(row):
        found = follow_mask(images, truths[0])
    scores = [(jaccard(m, t), boundary_score(m, t)) for m, t in zip(found[1:], truths[1:], strict=True)]
    row["jaccard"], row["boundary"] = (round(float(v), 3) for v in np.mean(scores, axis=0))
    row["error"] = round(1 - (row["jaccard"] + row["boundary"]) / 2, 3)
    row |= {key: round(row[key] / len(paths), 3) for key in ("seconds", "cpu_seconds")}
    shown = np.linspace(0, len(paths) - 1, 8).astype(int)
    pictures = [_tint(images[i], found[i]) for i in shown]
    io.write_png(output / f"clip_{clip}.png", tile_images([pictures[:4], pictures[4:]]))
    return row


def _tint(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    tinted = image.copy()
    tinted[mask] = tinted[mask] // 2 + np.array([127, 0, 0], np.uint8)
    return cv2.resize(tinted, (480, 480 * image.shape[0] // image.shape[1]), interpolation=cv2.INTER_AREA)


class Event:
    """The demo, finished in a folder, and its truth."""

    def __init__(self, folder: Path, scene: str, output: Path) -> None:
        self.results, self.output = folder / "results" / scene, output
        self.scene: SceneCameras = read_cameras(self.results / "sfm" / "cameras.json")
        self.films = [str(self.results / f"frames/cameras/{name}.npz") for name in self.scene.inputs]
        self.disparity = sorted(self.results.glob("disparity/*/0*.npz"))
        self.fuse = FuseOptions(min_pairs=2)
        self.demo = DemoOptions()
        self.depths = [output / "depth.npz"]
        if not self.disparity:
            raise InputError(f"expected disparities below {self.results}, found none: raise keep_gb")
        if not self.depths[0].is_file():
            frames = list(range(self.scene.num_frames))
            depths.run(
                self.results / "sfm/cameras.json",
                frames,
                self.disparity,
                self.films,
                self.fuse,
                self.depths[0],
            )

    def label(self, camera: str, frame: int) -> np.ndarray:
        """(H, W) uint8 of the truth."""
        time_s = float(clip_times(self.demo)[frame])
        return FrozenScene(time_s, self.demo).trace(camera_at(camera, time_s, self.demo))[1]

    def without(
        self, camera: str, frame: int, labels: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray, Camera]:
        """Picture and depth of the event without some of it, and the camera."""
        time_s = float(clip_times(self.demo)[frame])
        view = camera_at(camera, time_s, self.demo)
        image, depth, _ = FrozenScene(time_s, self.demo, labels).render(view)
        return image, depth, view

    def depth(self, camera: str, frame: int) -> tuple[np.ndarray, Camera]:
        """True depth of a picture as it was filmed, and its camera."""
        time_s = float(clip_times(self.demo)[frame])
        view = camera_at(camera, time_s, self.demo)
        return FrozenScene(time_s, self.demo).trace(view)[0], view


def mark_edit(event: Event, name: str) -> Edit:
    """An edit marked by a box around its figure."""
    camera, frame, _, operation, order = EDITS[name]
    y, x = np.nonzero(event.label(camera, frame) == LABEL_OF_MARK[name])
    corners = (float(x.min() - 3), float(y.min() - 3)), (float(x.max() + 3), float(y.max() + 3))
    return Edit(name, "demo", operation, order, (VIEW,), (Mark(camera, frame, "box", corners),))


def bench_masks(event: Event, edit: Edit, options: EditOptions) -> dict[str, Any]:
    """Carry a box to all cameras and frames. Error is 1 - mean IoU where it shows; times are per frame."""
    labels = EDITS[edit.name][2]
    row: dict[str, Any] = {"experiment": "masks", "subject": edit.name}
    path = event.output / f"masks_{edit.name}.npz"
    with measured(row):
        masks.run(edit, event.results / "sfm/cameras.json", event.films, event.depths, [], options, path)
    archive = io.Archive(path)
    scores = []
    for f in archive.frames():
        for cam in event.scene.inputs:
            truth = np.isin(event.label(cam, f), labels)
            if truth.sum() >= 20:
                scores.append(jaccard(archive[f"{f:06d}/{cam}"] > 0, truth))
    row["jaccard"] = round(float(np.mean(scores)), 3)
    row["error"] = round(1 - row["jaccard"], 3)
    return row | {key: round(row[key] / event.scene.num_frames, 3) for key in ("seconds", "cpu_seconds")}


def sweep_option(event: Event, key: str, frames: Sequence[int]) -> Iterator[dict[str, Any]]:
    """Rows of the man's edit with other settings. Soft edges leave masks as they are."""
    edit = mark_edit(event, "man")
    for value in SWEEPS[key]:
        options = dataclasses.replace(EditOptions(), **{key: value})
        if key == "num_times" or not (event.output / "masks_man.npz").is_file():
            yield bench_masks(event, edit, options) | {"subject": f"man, {key} {value}"}
        yield bench_view(event, edit, options, frames) | {"subject": f"man, {key} {value}"}


def bench_view(event: Event, edit: Edit, options: EditOptions, frames: Sequence[int]) -> dict[str, Any]:
    """Edit a camera's film and compare it with the event rendered without the thing; times are per frame."""
    labels = EDITS[edit.name][2]
    background = next((event.results / "edit" / "background" / VIEW).glob("*.npz"))
    view = event.results / "edit" / "views" / f"{VIEW}.json"
    models = sorted(event.results.glob("composition/*/model.pt"))
    files = films.Files(
        event.output / f"masks_{edit.name}.npz", view, event.results / "sfm/cameras.json", event.films,
        event.depths, event.disparity, background, models, [], event.results / f"frames/cameras/{VIEW}.npz",
    )  # fmt: skip
    row: dict[str, Any] = {"experiment": edit.operation, "subject": edit.name}
    folder = event.output / edit.name
    with measured(row):
        films.run(edit, files, frames, options, event.fuse, RenderOptions(), folder)
    row |= {key: round(row[key] / len(frames), 3) for key in ("seconds", "cpu_seconds")}
    legend = io.read_json(folder / "provenance.json")
    scores, rights, changes, pictures, last = [], [], [], [], None
    for frame in frames:
        image = io.read_image(folder / f"{frame:06d}.png")
        origin = io.read_image(folder / "provenance" / f"{frame:06d}.png")
        truth, depth, view_camera = event.without(VIEW, frame, labels)
        base = event.without(VIEW, frame, ())[0]
        label = event.label(VIEW, frame)
        changed = np.abs(truth.astype(int) - base).max(axis=2) > CHANGED_LEVELS
        regions = changed, np.isin(label, labels), ~changed
        scores.append([psnr(image, truth, region) for region in regions])
        rights += _provenance_is_right(event, origin, depth, view_camera, legend, changed)
        static = (origin[..., 0] > 0) & ~np.isin(label, [n for n in (1, 2, 3) if n not in labels])
        if last is not None:
            both = static & last[2]
            steps = (image.astype(int) - last[0], truth.astype(int) - last[1])
            changes.append([float(np.abs(step[both]).mean()) for step in steps])
        last = image, truth, static
        pictures.append([base, image, truth])
    means = np.ma.masked_invalid(scores).mean(axis=0)
    for key, value in zip(("psnr_changed_db", "psnr_thing_db", "psnr_outside_db"), means, strict=True):
        row[key] = round(float(value), 2)
    row["provenance_right"] = round(float(np.mean(rights)), 4) if rights else ""
    ours, true = np.mean(changes, axis=0) if changes else (0.0, 1.0)
    row["flicker_ratio"] = round(float(ours / true), 3)
    row["error"] = row["psnr_changed_db"]
    io.write_png(event.output / f"view_{edit.name}.png", tile_images(pictures[:: max(1, len(pictures) // 5)]))
    return row


def _provenance_is_right(
    event: Event,
    origin: np.ndarray,
    depth: np.ndarray,
    view: Camera,
    legend: dict[str, Any],
    region: np.ndarray,
) -> list[bool]:
    """Whether the camera and time that are named saw the surface that is there, pixel by pixel."""
    kind, camera, frame = np.moveaxis(origin, -1, 0)
    wanted = region & np.isin(kind, (SAME_TIME, OTHER_TIME)) & np.isfinite(depth)
    right: list[bool] = []
    for cam, time_index in {(c, f) for c, f in zip(camera[wanted], frame[wanted], strict=True)}:
        y, x = np.nonzero(wanted & (camera == cam) & (frame == time_index))
        seen, sight = event.depth(legend["cameras"][cam], legend["frames"][time_index])
        points = view.unproject(np.stack([x, y], axis=-1).astype(float), depth[y, x].astype(float))
        pixels, z = sight.project(points)
        height, width = seen.shape
        # A pixel to either side: surfaces seen at a slant change within one.
        differences = [
            np.abs(
                seen[
                    np.clip(np.rint(pixels[:, 1]).astype(int) + dy, 0, height - 1),
                    np.clip(np.rint(pixels[:, 0]).astype(int) + dx, 0, width - 1),
                ]
                - z
            )
            for dy in (-1, 0, 1)
            for dx in (-1, 0, 1)
        ]
        right += (np.min(differences, axis=0) <= SAME_SURFACE * z).tolist()
    return right


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the bench."""
    parser = argparse.ArgumentParser(prog="python -m benches.edit", description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--clips", type=Path, help="folder with JPEGImages and Annotations")
    parser.add_argument("--event", type=Path, help="folder in which the demo was made")
    parser.add_argument("--scene", default="demo_known")
    parser.add_argument("--edits", nargs="*", choices=list(EDITS), default=list(EDITS))
    parser.add_argument("--sweep", nargs="*", choices=list(SWEEPS), default=[], help="settings to vary")
    parser.add_argument("--frames", type=int, nargs="*", default=list(range(3, 27)))
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    rows: list[dict[str, Any]] = []

    def add(make: Callable[[], dict[str, Any]]) -> None:
        rows.append(make())
        print(" ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
        io.write_csv(output / "edit.csv", COLUMNS, rows)

    output = args.output.resolve()
    if args.clips:
        for folder in sorted((args.clips / "JPEGImages").iterdir()):
            add(lambda folder=folder: bench_clip(args.clips, folder.name, output))
    if args.event:
        # Films are named relative to the folder that the workflow ran in.
        os.chdir(args.event)
        event, options = Event(Path(), args.scene, output), EditOptions()
        for name in args.edits:
            edit = mark_edit(event, name)
            add(lambda edit=edit: bench_masks(event, edit, options))
            add(lambda edit=edit: bench_view(event, edit, options, args.frames))
        for key in args.sweep:
            for row in sweep_option(event, key, args.frames):
                add(lambda row=row: row)


if __name__ == "__main__":
    main()
