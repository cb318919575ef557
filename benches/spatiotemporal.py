"""Error against time of the joint solve of clocks and trajectories, on a generated person with true clocks.

    python -m benches.spatiotemporal --output DIR [--num-seeds 3]

benches/articulated_motion.py says what is filmed. Writes spatiotemporal.csv (one row per setting and
option: errors of the offsets in frames of 1/30 s, their ratio to the stated standard deviation, processor
seconds) and spatiotemporal_weight.csv (the estimated weight of the prior against fixed ones).
"""

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benches.articulated_motion import FPS, Setting, Take, film
from fourd import io
from fourd.align.clock import CameraClock
from fourd.align.joint_solve import Limits, improve, solve_jointly, start_fit
from fourd.align.point_observations import connected, prepare_observations
from fourd.align.spatiotemporal import refine_clocks
from fourd.align.spatiotemporal_options import SpatiotemporalOptions
from fourd.align.trajectory_fit import Clocks, Unknowns

JOINT = {"start": "joint"}
HIDDEN = Setting(hidden=0.3, wrong=0.05)
ROWS: tuple[tuple[str, Setting, dict], ...] = (
    ("noise 2.0 px", Setting(), {}),
    ("30 % hidden, 5 % wrong", HIDDEN, {}),
    *(
        (f"noise {noise} px", Setting(noise_px=noise), {"prior": prior, **JOINT})
        for noise in (0.0, 0.5, 1.0, 2.0)
        for prior in ("force", "kinetic")
    ),
    *(
        (f"noise {noise} px, 30 % hidden, 5 % wrong", dataclasses.replace(HIDDEN, noise_px=noise), JOINT)
        for noise in (0.0, 0.5, 1.0, 2.0)
    ),
    ("start 5 frames off", Setting(start_frames=5), {"search_frames": 6.0, **JOINT}),
    ("3 of 6 cameras strange", Setting(num_cams=6, strangers=3), {}),
    ("3 of 6 cameras strange", Setting(num_cams=6, strangers=3), JOINT),
    ("3 cameras", Setting(num_cams=3), {}),
    *(("2 cameras", Setting(num_cams=2), {"prior": prior}) for prior in ("force", "kinetic")),
    *(("noise 2.0 px", Setting(), {"knot_spacing_frames": k, **JOINT}) for k in (0.5, 2.0, 3.0, 4.0)),
    *(("2 cameras", Setting(num_cams=2), {"knot_spacing_frames": k}) for k in (0.5, 2.0, 3.0, 4.0)),
    *(("3 of 6 cameras strange", Setting(num_cams=6, strangers=3), {"pair_points": n}) for n in (6, 24)),
    *(("3 of 6 cameras strange", Setting(num_cams=6, strangers=3), {"group_points": n}) for n in (12, 20)),
)
COLUMNS = (
    "setting",
    "options",
    "error",
    "max_frames",
    "sigma_ratio",
    "num_refused",
    "num_false",
    "noise_scale",
    "condition_number",
    "cpu_seconds",
)


def measure(setting: Setting, changes: dict, num_seeds: int) -> dict[str, float]:
    """Figures of some takes: error is the median over cameras and takes, frames.

    num_false: cameras of another event accepted, or good ones refused
    """
    options = SpatiotemporalOptions(**changes)
    errors: list[float] = []
    ratios: list[float] = []
    num_refused = num_false = 0
    noise, condition = [], []
    cpu_start = time.process_time()
    for seed in range(num_seeds):
        take = film(setting, seed)
        guesses = {
            name: CameraClock(float(guess))
            for name, guess in zip(take.points.names, take.guesses_s, strict=True)
        }
        result = refine_clocks(take.points, take.cameras, guesses, take.points.names[0], options)
        clocks = list(result.clocks.values())
        is_ok = np.array([clock.status == "ok" for clock in clocks])
        is_strange = np.isin(np.arange(len(clocks)), take.strangers)
        num_refused += int((~is_ok).sum())
        num_false += int((is_ok == is_strange).sum())
        error = (np.array([clock.offset_s for clock in clocks]) - take.offsets_s) * FPS
        sigma = np.array([clock.sigma_s for clock in clocks]) * FPS
        used = is_ok & (sigma > 0)
        errors += list(np.abs(error[used]))
        ratios += list(error[used] / sigma[used])
        noise.append(result.noise_scale)
        condition.append(result.condition_number)
    return {
        "error": float(np.median(errors)) if errors else float("nan"),
        "max_frames": max(errors, default=float("nan")),
        "sigma_ratio": float(np.sqrt(np.mean(np.square(ratios)))) if ratios else float("nan"),
        "num_refused": num_refused,
        "num_false": num_false,
        "noise_scale": float(np.median(noise)),
        "condition_number": float(np.median(condition)),
        "cpu_seconds": (time.process_time() - cpu_start) / num_seeds,
    }


def measure_weight(take: Take, prior: str, factor: float | None) -> tuple[float, float]:
    """Median error (frames) with the estimated weight times a factor, and that weight.

    factor: None leaves each trajectory its own estimate; a number fixes all to the median times it
    """
    observations = prepare_observations(take.points, take.cameras)
    num = len(take.offsets_s)
    zeros = np.zeros(num)
    clocks = Clocks(take.guesses_s.copy(), zeros, zeros)
    observations = connected(observations, clocks.times(observations), np.ones(num, dtype=bool), 0.2, 0.5)
    cams = np.arange(1, num)
    unknowns = Unknowns(np.zeros(num - 1, int), cams, take.guesses_s[1:], np.full(num - 1, np.inf))
    limits = Limits(take.guesses_s[1:] - 0.1, take.guesses_s[1:] + 0.1, np.full(num - 1, 0.5 / FPS))
    fit = solve_jointly(start_fit(observations, clocks, 1 / FPS, 0.2, prior), unknowns, limits, 4e-4)
    if factor is not None:
        fixed = np.full(len(fit.weight), np.median(fit.weight) * factor)
        fit = dataclasses.replace(fit, weight=fixed)
        for _ in range(10):
            fit = improve(fit, unknowns, limits.lower, limits.upper, 1e-9)
    error = np.abs(fit.clocks.offset_s - take.offsets_s)[1:] * FPS
    return float(np.median(error)), float(np.median(fit.weight))


def weight_table(num_seeds: int) -> list[dict]:
    """Errors with the estimated weight, per trajectory and common, and with wrong ones."""
    rows = []
    for num_cams in (2, 10):
        for prior in ("force", "kinetic"):
            for factor in (None, 1.0, 1e-4, 1e-2, 1e2, 1e4):
                takes = [film(Setting(num_cams=num_cams), seed) for seed in range(num_seeds)]
                found = np.array([measure_weight(take, prior, factor) for take in takes])
                rows.append(
                    {
                        "cameras": num_cams,
                        "prior": prior,
                        "factor": "estimated" if factor is None else factor,
                        "error": float(np.median(found[:, 0])),
                        "max_frames": float(found[:, 0].max()),
                        "weight": float(np.median(found[:, 1])),
                    }
                )
                print(rows[-1], flush=True)
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--num-seeds", type=int, default=3)
    args = parser.parse_args(argv)
    rows = []
    for name, setting, changes in ROWS:
        options = " ".join(f"{key}={value}" for key, value in changes.items()) or "default"
        rows.append({"setting": name, "options": options} | measure(setting, changes, args.num_seeds))
        print(
            "  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{v}" for k, v in rows[-1].items()),
            flush=True,
        )
    io.write_csv(args.output / "spatiotemporal.csv", COLUMNS, rows)
    rows = weight_table(args.num_seeds)
    io.write_csv(args.output / "spatiotemporal_weight.csv", tuple(rows[0]), rows)


if __name__ == "__main__":
    main()
