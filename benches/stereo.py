"""Error against time of the matcher's settings, on rectified pairs with true disparity.

    python -m benches.stereo --data DIR --output DIR [--psmnet WEIGHTS]

Every folder below DATA that holds view1.png, view5.png and disp1.png, or im2.png, im6.png and
disp2.png, is a pair; disp is an 8-bit image of disparity times 3 or 4 (Middlebury 2003, 2005).
Writes stereo.csv: one row per setting, means over the pairs, as they are and (unlike_*) with gain,
gamma, noise and JPEG on the right image, and (turned_*) with the right camera rolled and tilted by 0.1
degrees; stereo.png: the front; reliability.csv and reliability.png: expected against actual error.
With --psmnet there is a row for the learned matcher, half a minute a pair on a processor. Errors of the
reliability are cut at 2 px. Of the true disparities of Middlebury pairs only the share that both images
show (85 %) can be matched; density counts all of them.
"""

import argparse
import dataclasses
import math
import resource
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from benches.pareto import plot_front
from fourd import io
from fourd.camera import Camera
from fourd.matchers import Matcher
from fourd.stereo.disparity import PairDisparity, StereoOptions, find_row_shift, make_matcher, match_pair
from fourd.stereo.rectify import Rectification

LAYOUTS = (("view1.png", "view5.png", "disp1.png", 3), ("im2.png", "im6.png", "disp2.png", 4))
SGBM = {"matcher": "sgbm"}
SETTINGS = {
    "default": {},
    "unrefined": {"is_refined": False},
    "left_right_1px": {"max_left_right_px": 1.0},
    "left_right_2px": {"max_left_right_px": 2.0},
    "support_11px_50": {"support_px": 11, "min_support": 0.5},
    "census": {"matcher": "census"},
    "sgbm": SGBM,
    "sgbm_hh4": SGBM | {"sgbm_mode": "hh4"},
    "sgbm_hh4_dense": SGBM | {"sgbm_mode": "hh4", "sgbm_uniqueness_percent": 0, "max_left_right_px": 2.0},
    "sgbm_hh": SGBM | {"sgbm_mode": "hh"},
    "sgbm_5way": SGBM | {"sgbm_mode": "sgbm"},
    "sgbm_block3": SGBM | {"sgbm_block_size_px": 3, "sgbm_penalty_small": 4, "sgbm_penalty_large": 32},
    "sgbm_smooth": SGBM | {"sgbm_penalty_small": 8, "sgbm_penalty_large": 96},
    "sgbm_rough": SGBM | {"sgbm_penalty_small": 4, "sgbm_penalty_large": 16},
    "sgbm_unique10": SGBM | {"sgbm_uniqueness_percent": 10},
}
UNLIKE_SETTINGS = {
    "unlike_default": {},
    "unlike_plain": {"match_tones": False},
    "unlike_census": {"matcher": "census"},
    "unlike_sgbm": SGBM,
}
TURNED_SETTINGS = {"turned_default": {}, "turned_unaligned": {"align_rows": False}}
TURN_DEG = 0.1
GAIN, GAMMA, NOISE_LEVELS, JPEG_QUALITY = 0.8, 1.2, 4.0, 70
CUT_PX = 2.0
SIGMA_EDGES_PX = (0, 0.16, 0.2, 0.25, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4, np.inf)
RELIABILITY_COLUMNS = ("expected_px", "actual_px", "share")
COLUMNS = (
    "setting",
    "error",
    "bad_2px",
    "bad_1px",
    "median_px",
    "density",
    "sigma_ratio",
    "seconds",
    "cpu_seconds",
    "peak_rss_mb",
)


@dataclasses.dataclass(frozen=True)
class Pair:
    left: np.ndarray
    right: np.ndarray
    truth: np.ndarray


def find_pairs(data: Path) -> Iterator[Pair]:
    """Pairs with truth (H, W) float32 px, NaN where unknown."""
    for left, right, disparity, scale in LAYOUTS:
        for path in sorted(data.rglob(disparity)):
            raw = io.read_image(path)[:, :, 0].astype(np.float32)
            truth = np.where(raw > 0, raw / scale, np.nan).astype(np.float32)
            yield Pair(io.read_image(path.parent / left), io.read_image(path.parent / right), truth)


def make_unlike(pair: Pair) -> Pair:
    """The pair with a right image of a darker, harder, noisy and compressed camera."""
    levels = 255 * GAIN * (pair.right / 255) ** GAMMA
    levels += np.random.default_rng(0).normal(0, NOISE_LEVELS, levels.shape)
    right = np.rint(levels.clip(0, 255)).astype(np.uint8)
    coded = cv2.imencode(".jpg", right[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    decoded = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    assert decoded is not None
    return dataclasses.replace(pair, right=np.ascontiguousarray(decoded[..., ::-1]))


def make_turned(pair: Pair) -> Pair:
    """The pair with a right camera that is rolled and tilted by a little, unknown to its calibration."""
    K = rectification_of(pair)[0].K_right
    turn = Rotation.from_euler("zx", [TURN_DEG, TURN_DEG], degrees=True).as_matrix()
    height, width = pair.truth.shape
    right = cv2.warpPerspective(
        pair.right, K @ turn @ np.linalg.inv(K), (width, height), flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return dataclasses.replace(pair, right=right)


def rectification_of(pair: Pair) -> tuple[Rectification, Camera]:
    """The pair as it is: unit baseline, any focal length, and the camera of its images."""
    height, width = pair.truth.shape
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    size = (width, height)
    top = float(np.nanmax(pair.truth)) + 2
    rectification = Rectification(K, K, np.eye(3), np.zeros(3), np.array([1.0, 0, 0]), size, (0.0, top))
    return rectification, Camera(K, np.eye(3), np.zeros(3), size)


def measure(pairs: Sequence[Pair], options: StereoOptions) -> dict[str, float]:
    matcher = make_matcher(options)
    rows = []
    start, cpu_start = time.perf_counter(), time.process_time()
    results = [_match(pair, matcher, options) for pair in pairs]
    seconds, cpu_seconds = time.perf_counter() - start, time.process_time() - cpu_start
    for pair, result in zip(pairs, results, strict=True):
        known = np.isfinite(pair.truth)
        both = known & np.isfinite(result.left_disparity)
        error = np.abs(result.left_disparity - pair.truth)[both]
        predicted = result.sigma_px / result.left_confidence[both]
        inlier = error < 3
        rows.append(
            {
                "bad_2px": np.mean(error > 2),
                "bad_1px": np.mean(error > 1),
                "median_px": np.median(error),
                "density": both.sum() / known.sum(),
                "sigma_ratio": math.sqrt(np.mean((error / predicted)[inlier] ** 2)),
            }
        )
    means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
    return means | {
        "error": means["bad_2px"],
        "seconds": seconds / len(pairs),
        "cpu_seconds": cpu_seconds / len(pairs),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def measure_reliability(pairs: Sequence[Pair], options: StereoOptions) -> list[dict[str, float]]:
    """Root mean square of the expected and of the actual error, per bin of the expected one."""
    matcher = make_matcher(options)
    expected, actual = [], []
    for pair in pairs:
        result = _match(pair, matcher, options)
        both = np.isfinite(pair.truth) & np.isfinite(result.left_disparity)
        expected.append(result.sigma_px / result.left_confidence[both])
        actual.append(np.minimum(np.abs(result.left_disparity - pair.truth)[both], CUT_PX))
    sigma, error = np.concatenate(expected), np.concatenate(actual)
    bins = np.digitize(sigma, SIGMA_EDGES_PX)
    return [
        {
            "expected_px": math.sqrt(np.mean(sigma[bins == i] ** 2)),
            "actual_px": math.sqrt(np.mean(error[bins == i] ** 2)),
            "share": float(np.mean(bins == i)),
        }
        for i in np.unique(bins)
    ]


def plot_reliability(rows: Sequence[dict[str, float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(5, 5))
    axes.plot([0, 1.6], [0, 1.6], color="grey", linewidth=1)
    axes.plot([row["expected_px"] for row in rows], [row["actual_px"] for row in rows], marker="o")
    axes.set(xlabel="expected error (px)", ylabel="actual error (px)", title="Disparity knows its error")
    figure.savefig(path, dpi=120, bbox_inches="tight")
    plt.close(figure)


def _match(pair: Pair, matcher: Matcher, options: StereoOptions) -> PairDisparity:
    rectification, camera = rectification_of(pair)
    cameras, images = (camera, camera), (pair.left, pair.right)
    rows = find_row_shift(rectification, cameras, images, options) if options.align_rows else None
    return match_pair(rectification, cameras, images, matcher, options, rows)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--psmnet", type=Path, help="weights of the learned matcher")
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    pairs = list(find_pairs(args.data))
    if not pairs:
        raise SystemExit(
            f"error: no rectified pairs with truth below {args.data}: see the head of benches/stereo.py"
        )
    unlike = [make_unlike(pair) for pair in pairs]
    # What is compiled on first use is not the first setting's time.
    measure(pairs[:1], StereoOptions())
    rows = []
    turned = [make_turned(pair) for pair in pairs]
    plain = dict(SETTINGS)
    if args.psmnet is not None:
        plain["psmnet"] = {"matcher": "psmnet", "network_file": str(args.psmnet)}
    for settings, data in ((plain, pairs), (UNLIKE_SETTINGS, unlike), (TURNED_SETTINGS, turned)):
        for name, changes in settings.items():
            rows.append({"setting": name} | measure(data, dataclasses.replace(StereoOptions(), **changes)))
            print(
                "  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{v:16s}" for k, v in rows[-1].items())
            )
    io.write_csv(args.output / "stereo.csv", COLUMNS, rows)
    plot_front(args.output / "stereo.png", rows[: len(plain)], "setting", "default")
    reliability = measure_reliability(pairs, StereoOptions())
    for row in reliability:
        print("  ".join(f"{key} {value:.3f}" for key, value in row.items()))
    io.write_csv(args.output / "reliability.csv", RELIABILITY_COLUMNS, reliability)
    plot_reliability(reliability, args.output / "reliability.png")


if __name__ == "__main__":
    main()
