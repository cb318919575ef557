"""Mean, deviation and 95 % interval of a metric over held-out cameras and their frames."""

import dataclasses
import math
import statistics
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats

NUM_RESAMPLES = 1000
SEED = 0
LEVEL = 0.95
COLUMNS = ("region", "method", "metric", "mean", "std", "low", "high", "num_frames", "num_views", "note")
# Values outside cannot occur, so no interval reaches there.
BOUNDS = {
    "mse": (0.0, math.inf),
    "ssim": (-1.0, 1.0),
    "ms_ssim": (0.0, 1.0),
    "lpips_alex": (0.0, math.inf),
    "lpips_vgg": (0.0, math.inf),
    "fid": (0.0, math.inf),
    "frechet_alex": (0.0, math.inf),
    "frechet_vgg": (0.0, math.inf),
    "flicker": (0.0, math.inf),
}
Row = Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class Summary:
    """One method, region and metric; low and high are NaN where one value or an infinite one allows none."""

    mean: float
    std: float
    low: float
    high: float
    num_frames: int
    num_views: int


def summarize(values: Sequence[float]) -> tuple[float, float]:
    """Mean and sample standard deviation (0 for one value); infinite values make both infinite and NaN."""
    mean = statistics.fmean(values)
    if len(values) < 2:
        return mean, 0.0
    return mean, statistics.stdev(values) if math.isfinite(mean) else math.nan


def bootstrap_interval(groups: Sequence[np.ndarray]) -> tuple[float, float]:
    """95 % interval of the mean over frames and cameras; NaN for fewer than two values.

    groups: values of the frames of each camera, finite
    Cameras are drawn with replacement, each with all of its frames: their mean has the noise of the
    frames in it already, and frames drawn again within cameras would count it twice. The interval
    is for other cameras and moments of the event. Percentiles of few cameras lie too close
    together, so their distance from the mean is stretched to what Student's distribution asks for
    that many. Of one camera frames are drawn, as if they were independent: it speaks of that camera
    alone.
    Source: Davison, Hinkley, "Bootstrap methods and their application", 1997, section 3.8 (groups
    with replacement, members without); Hesterberg, "What teachers should know about the bootstrap",
    The American Statistician 2015 (intervals of n too narrow by sqrt((n - 1) / n) and Student's quantile).
    """
    groups = [np.asarray(group, np.float64) for group in groups if len(group)]
    if len(groups) == 1:
        groups = [np.array([value]) for value in groups[0]]
    if len(groups) < 2:
        return math.nan, math.nan
    totals, counts = np.array([group.sum() for group in groups]), np.array([len(group) for group in groups])
    drawn = np.random.default_rng(SEED).integers(0, len(groups), (NUM_RESAMPLES, len(groups)))
    means = totals[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    quantile = (1 + LEVEL) / 2
    tails = np.quantile(means, [1 - quantile, quantile])
    stretch = stats.t.ppf(quantile, len(groups) - 1) / stats.norm.ppf(quantile)
    stretch *= math.sqrt(len(groups) / (len(groups) - 1))
    mean = totals.sum() / counts.sum()
    low, high = mean + stretch * (tails - mean)
    return float(low), float(high)


def summarize_rows(rows: Sequence[Row], metric: str) -> Summary | None:
    """Summary of rows of one method, region and metric; None if none has a value."""
    groups: dict[str, list[float]] = {}
    for row in rows:
        if row["value"]:
            groups.setdefault(row["view"], []).append(float(row["value"]))
    values = [value for group in groups.values() for value in group]
    if not values:
        return None
    mean, std = summarize(values)
    low = high = math.nan
    if math.isfinite(mean):
        low, high = bootstrap_interval([np.array(group) for group in groups.values()])
        lowest, highest = BOUNDS.get(metric, (-math.inf, math.inf))
        low, high = max(low, lowest), min(high, highest)
    return Summary(mean, std, low, high, len(values), len(groups))


def differences(rows: Sequence[Row], method: str, reference: str) -> list[dict[str, str]]:
    """Rows of one metric and region: what a method has more than the reference on the same frame.

    Frames where either has no finite value are left out.
    """
    base = {(r["view"], r["frame"]): r["value"] for r in rows if r["method"] == reference}
    found = []
    for row in rows:
        other = base.get((row["view"], row["frame"]), "")
        if row["method"] != method or not row["value"] or not other:
            continue
        difference = float(row["value"]) - float(other)
        if math.isfinite(difference):
            found.append({**row, "value": repr(difference)})
    return found


def summarize_all(rows: Sequence[Row]) -> dict[tuple[str, str, str], tuple[Summary | None, str]]:
    """(region, method, metric) -> summary, None without a value, and the first note of its rows."""
    grouped: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        grouped.setdefault((row["region"], row["method"], row["metric"]), []).append(row)
    found = {}
    for key, chosen in grouped.items():
        summary = summarize_rows(chosen, key[2])
        # Of values and gaps, the note of a value holds for the mean.
        told = [row["note"] for row in chosen if summary is None or row["value"]]
        found[key] = (summary, told[0])
    return found


def summary_rows(
    summaries: Mapping[tuple[str, str, str], tuple[Summary | None, str]],
) -> list[dict[str, object]]:
    """Rows of summary.csv; numbers that are not defined are empty."""
    rows = []
    for (region, method, metric), (summary, note) in summaries.items():
        row: dict[str, object] = {"region": region, "method": method, "metric": metric, "note": note}
        numbers = dataclasses.asdict(summary) if summary else {"num_frames": 0, "num_views": 0}
        known = {key: "" if math.isnan(value) else repr(value) for key, value in numbers.items()}
        rows.append({**dict.fromkeys(COLUMNS, ""), **row, **known})
    return rows
