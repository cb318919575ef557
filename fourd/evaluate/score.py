"""Values of one frame: every method by region and metric, and reasons where there is none."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fourd import metrics
from fourd.baselines import Evidence
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.depth import CONSENSUS, SURFACE, score_depth
from fourd.evaluate.regions import compare_masks
from fourd.metrics_distribution import frechet_distance, kernel_distance
from fourd.metrics_fid import load_inception
from fourd.metrics_lpips import load_network, missing_weights

# By the first word of the metric.
SET_METRICS = {"frechet": frechet_distance, "kernel": kernel_distance, "fid": frechet_distance}
# No methods may have these names: the true pictures, and rows of the workflow's own masks and depths.
TRUTH = "truth"
MASKS = "masks"
ESTIMATES = (MASKS, CONSENSUS, SURFACE)
# Where a method is expected to have a value in every frame.
HEADLINE = ("full", "psnr_db")
# The frame of values that are of all frames of a camera together.
ALL_FRAMES = "all"
TOO_SMALL = f"a side is under {metrics.MS_SSIM_MIN_SIDE_PX} px"


@dataclasses.dataclass(frozen=True, eq=False)
class Frame:
    """What is kept of a frame until the next one.

    images: (H, W, 3) uint8 by method;  truth: (H, W, 3) uint8;  valid, moves: (H, W) bool
    """

    images: Mapping[str, np.ndarray]
    truth: np.ndarray
    valid: np.ndarray
    moves: np.ndarray


def score_image(
    image: np.ndarray, truth: np.ndarray, regions: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str, float, int]]:
    """(region, metric, value, num_pixels) of one image; NaN in an empty region.

    image, truth: (H, W, 3) uint8;  regions: (H, W) bool by name
    The SSIM of a full frame leaves out the border as in `metrics.ssim`; MS-SSIM is of region `full`
    only, and counts pixels outside it as they are in both pictures.
    """
    errors, maps = metrics.squared_error(image, truth), metrics.structure_maps(image, truth)
    for name, region in regions.items():
        count = int(region.sum())
        mean_error = float(errors[region].mean()) if count else math.nan
        if region.all():
            structure = metrics.mean_ssim(maps[0])
        else:
            structure = float(maps[0][region].mean()) if count else math.nan
        yield name, "mse", mean_error, count
        yield name, "psnr_db", metrics.psnr_from_mse(mean_error), count
        yield name, "ssim", structure, count
        if name == "full" and count:
            yield name, "ms_ssim", _ms_ssim(image, truth, maps), count


def _ms_ssim(image: np.ndarray, truth: np.ndarray, maps: tuple[np.ndarray, np.ndarray]) -> float:
    is_large = min(truth.shape[:2]) >= metrics.MS_SSIM_MIN_SIDE_PX
    return metrics.ms_ssim_from_maps(image, truth, maps) if is_large else math.nan


def score_flicker(method: str, frame: Frame, earlier: Frame) -> Iterator[tuple[str, str, float, int]]:
    """(region, `flicker`, grey levels, num_pixels) of a method in the static and the dynamic region.

    A pixel is dynamic if it is so in either frame.
    """
    change = metrics.flicker_map(frame.images[method], frame.truth, earlier.images[method], earlier.truth)
    valid, moves = frame.valid & earlier.valid, frame.moves | earlier.moves
    for name, region in (("static", valid & ~moves), ("dynamic", valid & moves)):
        count = int(region.sum())
        yield name, "flicker", float(change[region].mean(dtype=np.float64)) if count else math.nan, count


def score_masks(found: np.ndarray, true: np.ndarray) -> list[dict[str, Any]]:
    """Rows of the workflow's own masks of what moves against true ones, both (H, W) bool."""
    rows = []
    for metric, value in compare_masks(found, true).items():
        row = _row(MASKS, "dynamic", metric, value, int(true.sum()))
        rows.append({**row, "note": "" if row["value"] else "nothing is marked"})
    return rows


def score_true_depth(
    evidence: Evidence, true: np.ndarray, regions: Mapping[str, np.ndarray]
) -> list[dict[str, Any]]:
    """Rows of the workflow's own depth against the true one, (H, W) z in world units."""
    rows = []
    for method, region, metric, value, count in score_depth(evidence, true, regions):
        reason = "no true depth is known there" if metric == "depth_coverage" else "there is no estimate"
        row = _row(method, region, metric, value, count)
        rows.append({**row, "note": "" if row["value"] else reason})
    return rows


class Scorer:
    """Scores the frames of one camera in their order."""

    def __init__(self, options: EvaluateOptions) -> None:
        self._net = options.lpips_net
        self._lpips_metric = f"lpips_{self._net}"
        self._no_lpips = missing_weights(options.lpips_weights, options.lpips_net)
        self._network = (
            load_network(options.lpips_weights, options.lpips_net) if self._no_lpips is None else None
        )
        self._earlier: Frame | None = None
        self._inception = load_inception(options.inception) if options.inception else None
        # Metric of sets -> method -> feature of each picture.
        self._features: dict[str, dict[str, list[np.ndarray]]] = {}

    def score(
        self,
        frame: Frame,
        regions: Mapping[str, np.ndarray],
        reasons: Mapping[str, str],
        remarks: Mapping[str, str],
    ) -> list[dict[str, Any]]:
        """Rows of one frame without view and frame.

        regions: (H, W) bool by name, `full` among them;  reasons: method -> why it has no image
        remarks: method -> what to know about its image
        """
        rows = []
        features = self._look(TRUTH, frame.truth)
        for method, image in frame.images.items():
            values = list(score_image(image, frame.truth, regions))
            if self._earlier is not None and method in self._earlier.images:
                values += score_flicker(method, frame, self._earlier)
            num_pixels = int(regions["full"].sum())
            own = self._look(method, image)
            distance = math.nan if self._network is None else self._network.distance(own, features)
            values.append(("full", self._lpips_metric, distance, num_pixels))
            for region, metric, value, count in values:
                rows.append(_row(method, region, metric, value, count))
                rows[-1]["note"] = self._note(rows[-1], remarks.get(method, ""))
        for method, reason in reasons.items():
            rows.append({**_row(method, *HEADLINE, math.nan, 0), "note": reason})
        self._earlier = frame
        return rows

    def score_sets(self) -> list[dict[str, Any]]:
        """Rows of the frame `all` for the frames scored so far: how far each method's pictures, as a set,
        lie from the true ones. None without weights or the network of FID.
        """
        rows = []
        for metric, sets in self._features.items():
            distance, truth = SET_METRICS[metric.partition("_")[0]], sets.pop(TRUTH)
            for method, found in sets.items():
                # A method may lack frames; the true ones are then too many to compare with.
                has_all = len(found) == len(truth) >= 2
                value = distance(np.stack(found), np.stack(truth)) if has_all else math.nan
                rows.append(_row(method, "full", metric, value, len(found)))
                rows[-1]["note"] = "" if has_all else "it needs a picture in every frame, and two frames"
        return rows

    def _look(self, name: str, image: np.ndarray) -> Any:
        """Activations that LPIPS scores, empty without weights; what `score_sets` needs is kept."""
        layers = [] if self._network is None else self._network.features(image)
        if layers:
            mean = layers[-1].mean(dim=(0, 2, 3)).numpy()
            for metric in (f"frechet_{self._net}", f"kernel_{self._net}"):
                self._features.setdefault(metric, {}).setdefault(name, []).append(mean)
        if self._inception is not None:
            self._features.setdefault("fid", {}).setdefault(name, []).append(self._inception.describe(image))
        return layers

    def _note(self, row: Mapping[str, Any], remark: str) -> str:
        if row["value"] != "":
            return remark
        if row["num_pixels"] == 0:
            return "the region is empty"
        return str(self._no_lpips) if row["metric"] == self._lpips_metric else TOO_SMALL


def _row(method: str, region: str, metric: str, value: float, count: int) -> dict[str, Any]:
    return {
        "method": method,
        "region": region,
        "metric": metric,
        "value": format_value(value),
        "num_pixels": count,
    }


def format_value(value: float) -> str:
    """Shortest text that reads back equal; `inf` for identical images, nothing where undefined."""
    return "" if math.isnan(value) else repr(value)
