"""Less work for less time or disk: what is left out first, and what that is expected to cost in error."""

import bisect
import dataclasses
import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.plan.cost import GPU_RULES, Machine, forecast
from fourd.plan.files import read_machine_file, read_survey
from fourd.plan.options import PlanOptions, options_from_section
from fourd.plan.outline import list_jobs, list_rendering, list_training, steps_per_epoch
from fourd.plan.work import Survey, choose_work, rank_pairs

# Expected loss, dB of PSNR, each from a table of docs/performance.md; straight lines between the rows, level
# beyond them. Share of the pairs that can be matched: moving pixels of two held-out views (Plan). Sampled
# times of the background: its static pixels in four views of two events (Background). Training steps: gain
# of the network over pasting, full frame of two views (Composition).
PAIRS_DB = ((0.3, 1.7), (0.5, 0.74), (0.75, 0.11), (1.0, 0.0))
SAMPLES_DB = ((1, 3.7), (3, 0.35), (5, 0.35), (7, 0.0))
STEPS_GAIN_DB = ((0, 0.0), (635, 1.42), (1889, 1.69))
# Each of the coarser levels, which fill holes only. Assumed, not measured: no event of 540 lines was trained.
LEVEL_DB = 0.1
SHARES_OF_PAIRS = (1.0, 0.75, 0.5, 0.3)
SHARES_OF_EPOCHS = (1.0, 0.5, 0.25, 0.1)
NUMBERS_OF_SAMPLES = (7, 5, 3, 1)


@dataclasses.dataclass(frozen=True)
class Reduction:
    """What a budget leaves. max_pairs: None for all;  loss_db: expected, against the work without a budget

    num_levels: of the composition, the coarsest are dropped
    kept: intermediate files that stay on the disk to the end
    minutes, peak_bytes: forecast of a run from nothing;  fits: whether that is within the budget
    """

    max_pairs: int | None
    num_samples: int
    num_levels: int
    epochs: int
    kept: tuple[str, ...]
    loss_db: float
    minutes: float
    peak_bytes: float
    fits: bool


def fit_budget(
    outline: Mapping[str, Any],
    survey: Survey,
    options: PlanOptions,
    machine: Machine,
    minutes: float | None,
    disk_gb: float | None,
    fixed: Collection[str] = (),
) -> Reduction:
    """The least loss that fits, or the least time if nothing does.

    outline: of `describe_scene` for the configured work;  survey, options: as `choose_work`
    minutes: of a run from nothing on all cores of the machine;  disk_gb: at the fullest moment
    fixed: of `max_pairs`, `num_samples`, `max_levels` and `epochs` those that were asked for and stay
    The same arguments give the same result: finished jobs do not count.
    """
    found = []
    matched = choose_work(survey, outline["pairs"], options).matched
    network_costs = _price_network(outline, machine, fixed)
    kept_choices = [tuple(outline["kept"])] if disk_gb is None else _kept(outline["kept"])
    for max_pairs, num_samples, kept in itertools.product(
        [None] if "max_pairs" in fixed else _numbers_of_pairs(survey, matched),
        _numbers("num_samples", outline["num_samples"], NUMBERS_OF_SAMPLES, fixed),
        kept_choices,
    ):
        reduced = {**outline, "kept": kept, "num_samples": num_samples}
        limit = options if max_pairs is None else dataclasses.replace(options, max_pairs=max_pairs)
        work = choose_work(survey, outline["pairs"], limit)
        share = len(work.matched) / max(1, len(matched))
        rest = [job for job in list_jobs(reduced, survey, work) if job.rule not in GPU_RULES]
        rest_cost = forecast(rest, outline["size"], machine, {})
        for (num_levels, epochs), network in network_costs.items():
            took = rest_cost["minutes"] + network["minutes"]
            peak_bytes = rest_cost["peak_bytes"] + network["peak_bytes"]
            fits = took <= (minutes or math.inf) and peak_bytes <= (disk_gb or math.inf) * 1e9
            loss_db = expected_loss(outline, share, num_samples, num_levels, epochs)
            numbers = (max_pairs, num_samples, num_levels, epochs)
            found.append(Reduction(*numbers, kept, loss_db, took, peak_bytes, fits))
    fitting = [reduction for reduction in found if reduction.fits]
    if fitting:
        return min(fitting, key=lambda r: (r.loss_db, -len(r.kept), r.minutes))
    return min(found, key=lambda r: (r.minutes, r.peak_bytes))


def _price_network(
    outline: Mapping[str, Any], machine: Machine, fixed: Collection[str]
) -> dict[tuple[int, int], dict[str, Any]]:
    """(levels, epochs) -> cost of training and rendering, which depend on nothing else that is reduced."""
    training = outline["training"]
    levels = _numbers("max_levels", outline["num_levels"], range(outline["num_levels"] - 1, 0, -1), fixed)
    epochs = _numbers("epochs", training["epochs"], _shares(outline), fixed)
    costs = {}
    for key in itertools.product(levels, epochs):
        reduced = {**outline, "num_levels": key[0], "training": {**training, "epochs": key[1]}}
        jobs = [*list_training(reduced), *list_rendering(reduced)]
        costs[key] = forecast(jobs, outline["size"], machine, {})
    return costs


def expected_loss(
    outline: Mapping[str, Any], share_of_pairs: float, num_samples: int, num_levels: int, epochs: int
) -> float:
    """dB of PSNR that reduced work is expected to lose against the configured one."""
    per_epoch = steps_per_epoch(outline)
    wanted = outline["training"]["epochs"]
    steps = interpolate(STEPS_GAIN_DB, wanted * per_epoch) - interpolate(STEPS_GAIN_DB, epochs * per_epoch)
    samples = interpolate(SAMPLES_DB, num_samples) - interpolate(SAMPLES_DB, outline["num_samples"])
    levels = LEVEL_DB * (outline["num_levels"] - num_levels)
    return interpolate(PAIRS_DB, share_of_pairs) + samples + levels + steps


def interpolate(curve: Sequence[tuple[float, float]], at: float) -> float:
    """Value of a curve of rising places, straight between its points and level beyond them."""
    places = [place for place, _ in curve]
    i = bisect.bisect_left(places, at)
    if i == 0 or i == len(curve):
        return curve[min(i, len(curve) - 1)][1]
    (x0, y0), (x1, y1) = curve[i - 1 : i + 1]
    return y0 + (y1 - y0) * (at - x0) / (x1 - x0)


def _numbers_of_pairs(survey: Survey, matched: Sequence[str]) -> list[int | None]:
    """All pairs, and less as long as every camera that has a partner keeps one."""
    ranked = rank_pairs({name: survey.pairs[name] for name in matched})
    cameras = {camera for name in matched for camera in name.split("-")}
    least = next(
        (i for i in range(len(ranked) + 1) if cameras == {c for n in ranked[:i] for c in n.split("-")}), 0
    )
    counts = {max(least, math.ceil(share * len(matched))) for share in SHARES_OF_PAIRS[1:]}
    return [None, *sorted((c for c in counts if 0 < c < len(matched)), reverse=True)]


def _kept(kinds: Sequence[str]) -> list[tuple[str, ...]]:
    """What may stay, disparities given up first: only another trajectory needs them again."""
    return list(dict.fromkeys([tuple(kinds), tuple(k for k in kinds if k != "disparity"), ()]))


def _shares(outline: Mapping[str, Any]) -> list[int]:
    return [max(1, round(share * outline["training"]["epochs"])) for share in SHARES_OF_EPOCHS]


def _numbers(key: str, wanted: int, choices: Sequence[int], fixed: Collection[str]) -> list[int]:
    """The wanted number and the choices below it; only the wanted one where it is fixed."""
    return [wanted] if key in fixed else [wanted, *(c for c in dict.fromkeys(choices) if c < wanted)]


def reduce_config(
    config: Mapping[str, Any],
    outline: Mapping[str, Any],
    survey_path: Path,
    machine_path: Path,
    fixed: Collection[str],
) -> tuple[dict[str, Any], Reduction | None]:
    """The configuration within its `minutes` and `disk_gb`, and what that took.

    As it is, with None, without a budget or before both files are there. Other arguments as `fit_budget`.
    """
    minutes, disk_gb = config["minutes"], config["disk_gb"]
    if (minutes is None and disk_gb is None) or not (survey_path.is_file() and machine_path.is_file()):
        return dict(config), None
    reduction = fit_budget(
        outline,
        read_survey(survey_path),
        options_from_section(config["plan"]),
        read_machine_file(machine_path),
        minutes,
        disk_gb,
        fixed,
    )
    return apply_reduction(config, reduction), reduction


def describe_budget(config: Mapping[str, Any], reduction: Reduction | None) -> dict[str, Any] | None:
    """The entry `budget` of plan/plan.json."""
    if reduction is None:
        return None
    entry = dataclasses.asdict(reduction)
    entry["forecast_minutes"] = entry.pop("minutes")
    return {"minutes": config["minutes"], "disk_gb": config["disk_gb"], **entry, "kept": list(reduction.kept)}


def apply_reduction(config: Mapping[str, Any], reduction: Reduction) -> dict[str, Any]:
    """The configuration with a budget's numbers in place of its own."""
    limited = (
        config["plan"] if reduction.max_pairs is None else config["plan"] | {"max_pairs": reduction.max_pairs}
    )
    return {
        **config,
        "plan": limited,
        "background": config["background"] | {"num_samples": reduction.num_samples},
        "composition": config["composition"] | {"epochs": reduction.epochs},
        "max_levels": min(config["max_levels"], reduction.num_levels),
    }


def fixed_keys(given: Mapping[str, Any]) -> set[str]:
    """Of the numbers that a budget may lower those that a person has given."""
    places = {"max_pairs": "plan", "num_samples": "background", "epochs": "composition"}
    keys = {
        key
        for key, section in places.items()
        if isinstance(given.get(section), Mapping) and key in given[section]
    }
    return keys | ({"max_levels"} & given.keys())
