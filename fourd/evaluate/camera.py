"""One held-out camera: every method's frames against what the camera filmed."""

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import metrics
from fourd.baselines import METHODS, Evidence
from fourd.config import spread_frames
from fourd.errors import InputError
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.contact_sheet import SheetRow, amplified_error, draw_sheet
from fourd.evaluate.regions import StillPicture, find_dynamic_pixels, read_dynamic_mask
from fourd.image import label_image, undistort
from fourd.ingest import open_camera
from fourd.io import Archive, read_image, write_csv, write_png
from fourd.render import BackgroundReader, list_frames, read_arrays, with_progress
from fourd.sfm import SceneCameras, read_cameras
from fourd.views import LEFT_OUT, View, ViewFrame, physical_view, read_view

COLUMNS = ("view", "frame", "dt_s", "method", "region", "region_source", "metric", "value", "num_pixels")
FOREGROUND_KEYS = ("consensus_rgb", "consensus_valid")
BACKGROUND_KEYS = ("farthest_rgb", "farthest_valid")
STILL_FRAMES = 15

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Sources:
    """Files of one held-out camera (docs/formats.md); `films` maps camera names to their files."""

    view: Path
    cameras: Path
    films: Mapping[str, Path]
    rendered: tuple[Path, ...]
    foreground: tuple[Path, ...]
    background: tuple[Path, ...]
    labels: Path | None = None


class EvidenceReader:
    """All that is known about one held-out view, frame by frame. Close after use."""

    def __init__(self, sources: Sources) -> None:
        self.view = read_view(sources.view)
        self._scene = read_cameras(sources.cameras)
        _check_heldout(self.view, self._scene, sources)
        self._labels = sources.labels
        self._readers = {
            name: open_camera(sources.films[name]) for name in (self.view.name, *self._scene.inputs)
        }
        self._rendered = list_frames(sources.rendered)
        self._archives = [Archive(path) for path in (*sources.foreground, *sources.background)]
        self._foreground: dict[int, Archive] = {}
        self._background: dict[int, BackgroundReader] = {}
        for archive in self._archives[: len(sources.foreground)]:
            self._foreground |= dict.fromkeys(archive.frames(), archive)
        for archive in self._archives[len(sources.foreground) :]:
            reader = BackgroundReader(archive, BACKGROUND_KEYS)
            self._background |= dict.fromkeys(reader.frames(), reader)
        self._still = self._make_still_picture()

    def close(self) -> None:
        for resource in (*self._readers.values(), *self._archives):
            resource.close()

    def read(self, entry: ViewFrame) -> tuple[Evidence, np.ndarray]:
        """What the methods may use for one frame, and (H, W) bool where the truth was filmed."""
        frame = entry.frame
        for found, what in (
            (self._rendered, "--rendered"),
            (self._foreground, "--foreground"),
            (self._background, "--background"),
        ):
            if frame not in found:
                raise InputError(
                    f"view {self.view.name}: expected frame {frame} in the files of {what}, found none: "
                    "give the files of all chunks"
                )
        truth, valid = self._see(self.view.name, entry)
        foreground = read_arrays(self._foreground[frame], frame, FOREGROUND_KEYS)
        background = self._background[frame].read(frame)
        rendered = read_image(self._rendered[frame])
        for image in (foreground["consensus_rgb"], background["farthest_rgb"], rendered):
            if image.shape != truth.shape:
                raise InputError(
                    f"view {self.view.name}, frame {frame}: expected pictures of {self.view.size} px, got "
                    f"{image.shape[1::-1]}: delete the older results and run again"
                )
        inputs = {name: self._see_input(name, entry.scene_frame) for name in self._scene.inputs}
        return Evidence(foreground, background, rendered, inputs, truth), valid

    def find_moves(self, entry: ViewFrame, evidence: Evidence, options: EvaluateOptions) -> np.ndarray:
        """(H, W) bool, where something moves: from the true masks if there are any."""
        if self._labels is not None:
            camera = self._scene.tracks[self.view.name].at(entry.scene_frame)
            shown = self._readers[self.view.name].source_frame(entry.scene_frame)
            return read_dynamic_mask(self._labels, shown, camera, entry.camera)
        background = evidence.background
        pictures = [(background["farthest_rgb"], background["farthest_valid"])]
        if self._still is not None:
            pictures.append(self._still.seen_from(entry.camera))
        return find_dynamic_pixels(evidence.truth, pictures, options)

    @property
    def region_source(self) -> str:
        """Where the dynamic region comes from: `truth` or `pipeline`."""
        return "pipeline" if self._labels is None else "truth"

    def dt_s(self, entry: ViewFrame) -> float:
        """When the true picture was taken after the moment that is rendered, seconds."""
        return self._readers[self.view.name].dt_s(entry.scene_frame)

    def _make_still_picture(self) -> StillPicture | None:
        """None where there are true masks, or too few frames for a median to leave out what moves."""
        frames = spread_frames(self._scene.num_frames, STILL_FRAMES)
        if self._labels is not None or len(frames) < 3:
            return None
        name = self.view.name
        return StillPicture([(self._readers[name].read(f), self._scene.tracks[name].at(f)) for f in frames])

    def _see(self, name: str, entry: ViewFrame) -> tuple[np.ndarray, np.ndarray]:
        # The truth is what was filmed: nothing in it is moved to the common time.
        image = self._readers[name].read(entry.scene_frame, is_compensated=name != self.view.name)
        return undistort(image, self._scene.tracks[name].at(entry.scene_frame), entry.camera)

    def _see_input(self, name: str, scene_frame: int) -> np.ndarray:
        return self._see(name, physical_view(self._scene, name, [scene_frame], self.view.size).frames[0])[0]


def _check_heldout(view: View, scene: SceneCameras, sources: Sources) -> None:
    if view.role != "heldout" or view.name not in scene.heldout:
        raise InputError(
            f"{sources.view}: expected the view of a held-out camera ({', '.join(scene.heldout) or 'none'}), "
            f"got {view.name} with role {view.role}: a camera that the result is made from proves nothing"
        )
    missing = [name for name in (view.name, *scene.inputs) if name not in sources.films]
    if missing:
        raise InputError(f"expected camera {missing[0]} in --films, got {', '.join(sources.films)}: add it")


def score_image(
    image: np.ndarray, truth: np.ndarray, regions: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str, float, int]]:
    """(region, metric, value, num_pixels) of one image; NaN in an empty region.

    image, truth: (H, W, 3) uint8;  regions: (H, W) bool by name
    The SSIM of a full frame leaves out the border as in `metrics.ssim`.
    """
    errors, similarity = metrics.squared_error(image, truth), metrics.ssim_map(image, truth)
    for name, region in regions.items():
        count = int(region.sum())
        mean_error = float(errors[region].mean()) if count else math.nan
        if region.all():
            structure = metrics.mean_ssim(similarity)
        else:
            structure = float(similarity[region].mean()) if count else math.nan
        yield name, "mse", mean_error, count
        yield name, "psnr_db", metrics.psnr_from_mse(mean_error), count
        yield name, "ssim", structure, count


def format_value(value: float) -> str:
    """Shortest text that reads back equal; `inf` for identical images, nothing where undefined."""
    return "" if math.isnan(value) else repr(value)


def run_camera(sources: Sources, output: Path, output_sheet: Path, options: EvaluateOptions) -> None:
    """Write the rows of one held-out camera and its contact sheet.

    A camera that was left out has no rows, and its sheet says why. Raises InputError.
    """
    view = read_view(sources.view)
    if view.role == LEFT_OUT:
        write_csv(output, COLUMNS, [])
        write_png(output_sheet, label_image(f"{view.name} is left out: {view.status}", (1200, 24)))
        return
    reader = EvidenceReader(sources)
    try:
        entries = reader.view.frames
        count = min(options.sheet_frames, len(entries))
        shown = {entries[(2 * i + 1) * len(entries) // (2 * count)].frame for i in range(count)}
        rows: list[dict[str, Any]] = []
        sheet: list[SheetRow] = []
        for entry in with_progress(entries, f"evaluate {reader.view.name}"):
            evidence, valid = reader.read(entry)
            moves = reader.find_moves(entry, evidence, options)
            regions = {"full": valid, "dynamic": moves & valid}
            images = {
                name: np.where(valid[..., None], method(evidence), np.uint8(0))
                for name, method in METHODS.items()
            }
            scores = _score_methods(images, evidence.truth, regions)
            rows += [
                {
                    "view": reader.view.name,
                    "frame": entry.frame,
                    "dt_s": f"{reader.dt_s(entry):.6f}",
                    "region_source": reader.region_source,
                    **score,
                }
                for score in scores
            ]
            if entry.frame in shown:
                sheet.append(
                    _sheet_row(reader.view.name, entry.frame, images, evidence.truth, scores, options)
                )
    finally:
        reader.close()
    write_csv(output, COLUMNS, rows)
    write_png(output_sheet, draw_sheet(sheet, options.sheet_tile_px, options.sheet_error_gain))


def _score_methods(
    images: Mapping[str, np.ndarray], truth: np.ndarray, regions: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    return [
        {
            "method": method,
            "region": region,
            "metric": metric,
            "value": format_value(value),
            "num_pixels": count,
        }
        for method, image in images.items()
        for region, metric, value, count in score_image(image, truth, regions)
    ]


def _sheet_row(
    name: str,
    frame: int,
    images: Mapping[str, np.ndarray],
    truth: np.ndarray,
    scores: Sequence[Mapping[str, Any]],
    options: EvaluateOptions,
) -> SheetRow:
    psnr = {(s["method"], s["region"]): s["value"] for s in scores if s["metric"] == "psnr_db"}
    captions = {"truth": f"{name}, frame {frame}"}
    for method in images:
        full, moving = (psnr[method, region] for region in ("full", "dynamic"))
        captions[method] = f"{float(full):.1f} dB" + (f", moving {float(moving):.1f} dB" if moving else "")
    error = amplified_error(images["ours"], truth, options.sheet_error_gain)
    return SheetRow({"truth": truth, "error": error, **images}, captions)
