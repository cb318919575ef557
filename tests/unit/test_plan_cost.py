"""Forecasts, budgets and the plan as a document."""

import dataclasses
from pathlib import Path

import pytest

from fourd.errors import InputError
from fourd.plan.budget import (
    LEVEL_DB,
    PAIRS_DB,
    SAMPLES_DB,
    STEPS_GAIN_DB,
    Reduction,
    apply_reduction,
    describe_budget,
    fit_budget,
    fixed_keys,
    interpolate,
    reduce_config,
)
from fourd.plan.cost import KINDS, RATES, Machine, corrections, cpu_seconds, forecast, read_finished
from fourd.plan.files import read_machine_file
from fourd.plan.options import PlanOptions
from fourd.plan.outline import Job, count_by_rule, list_jobs, list_rendering, list_training, list_viewer
from fourd.plan.show import check_document, describe, make_document, show_size, show_time
from fourd.plan.work import choose_work
from tests.unit.plan_scene import PAIRS, make_outline, make_scene, make_survey

MACHINE = Machine(num_cores=2)
CONFIG = {
    "plan": {"max_pairs": None, "foreground": "auto"},
    "background": {"num_samples": 7, "fill_px": 10},
    "composition": {"epochs": 10, "depth": 4},
    "max_levels": 3,
    "seed": 1,
}


def all_jobs(**settings: object) -> list[Job]:
    survey = make_survey()
    return list_jobs(make_outline(**settings), survey, choose_work(survey, PAIRS, PlanOptions()))


def viewer_jobs(num_moments: int = 90) -> list[Job]:
    lattice = {"views": ["lattice-00", "lattice-01"], "num_moments": num_moments, "size": [240, 135]}
    work = choose_work(make_survey(), PAIRS, PlanOptions())
    return list_viewer(make_outline(), lattice | {"size_mb": 19.0}, work)


def test_the_viewer_makes_every_view_in_chunks_and_one_page() -> None:
    counts = count_by_rule(viewer_jobs())
    assert counts.pop("viewer_page") == 1 and counts.pop("place_lattice") == 2
    assert set(counts.values()) == {2 * 2}
    # Pictures of half the width and height are a quarter of the work.
    half, full = (
        sum(job.amount for job in jobs if job.rule.startswith("render"))
        for jobs in (viewer_jobs(120), list_rendering(make_outline()))
    )
    views = sum(view["num_frames"] for view in make_outline()["views"].values() if view["role"] != "input")
    assert half / (2 * 120) == pytest.approx(full / views / 4)


def test_every_job_has_a_price() -> None:
    jobs = all_jobs(evaluate={"humans": "models"})
    assert {job.rule for job in [*jobs, *viewer_jobs()]} == set(RATES)
    costs = forecast(jobs, (480, 270), MACHINE, {})
    assert costs["jobs"] == costs["jobs_left"] == len(jobs)
    assert costs["cpu_minutes"] * 60 == pytest.approx(sum(cpu_seconds(job, MACHINE) for job in jobs))
    assert costs["minutes"] == pytest.approx(costs["cpu_minutes"] / 2)


def test_a_machine_twice_as_slow_takes_twice_as_long() -> None:
    slow = Machine(2, dict.fromkeys(KINDS, 2.0))
    costs = [forecast(all_jobs(), (480, 270), machine, {}) for machine in (MACHINE, slow)]
    assert costs[1]["cpu_minutes"] == pytest.approx(2 * costs[0]["cpu_minutes"])


def test_a_gpu_takes_the_network_off_the_processor() -> None:
    machine = dataclasses.replace(MACHINE, gpu_slowness=0.05, gpu_name="any")
    costs = [forecast(all_jobs(), (480, 270), one, {}) for one in (MACHINE, machine)]
    assert costs[0]["gpu_minutes"] == 0 < costs[1]["gpu_minutes"] < costs[0]["cpu_minutes"]
    assert costs[1]["minutes"] < costs[0]["minutes"]


def test_finished_jobs_correct_the_rest(tmp_path: Path) -> None:
    jobs = [Job("disparity", (pair, "000000-000059"), 8.0) for pair in PAIRS]
    said = cpu_seconds(jobs[0], MACHINE)
    header = "s\th:m:s\tmax_rss\tcpu_time\n"
    folder = tmp_path / "disparity" / PAIRS[0]
    folder.mkdir(parents=True)
    (folder / "000000-000059.tsv").write_text(f"{header}9\t0:00:09\t321.0\t{3 * said}\n")
    (tmp_path / "survey.tsv").write_text(f"{header}0.2\t0:00:00\tNA\t0.0\n")
    (tmp_path / "cut.tsv").write_text(header)
    finished = read_finished(tmp_path)
    assert finished == {("disparity", PAIRS[0], "000000-000059"): (3 * said, 321.0), ("survey",): (0.2, None)}
    assert corrections(jobs, finished, MACHINE) == {"disparity": pytest.approx(3.0)}
    row = forecast(jobs, (480, 270), MACHINE, finished)["rules"]["disparity"]
    assert (row["jobs"], row["jobs_done"], row["peak_mb"]) == (6, 1, 321.0)
    assert row["cpu_s"] == pytest.approx(5 * 3 * said)


def test_disk_of_what_passes_is_two_chunks() -> None:
    jobs = [Job("disparity", ("a-b", chunk), 0.0, 1e9, False) for chunk in ("samples", "0-1", "2-3", "4-5")]
    jobs.append(Job("fuse_training", ("0-1",), 0.0, 5e9))
    jobs += [Job("fuse_foreground", ("low", chunk), 0.0, 1e8, False) for chunk in ("0-1", "2-3", "4-5")]
    costs = forecast(jobs, (480, 270), MACHINE, {})
    # Fused images wait until the network is trained.
    assert (costs["end_bytes"], costs["peak_bytes"]) == (5e9, pytest.approx(8.3e9))


@pytest.mark.parametrize("curve", [PAIRS_DB, SAMPLES_DB, STEPS_GAIN_DB])
def test_curves_are_read_between_their_points(curve: tuple[tuple[float, float], ...]) -> None:
    assert [place for place, _ in curve] == sorted(place for place, _ in curve)
    values = [value for _, value in curve]
    assert [interpolate(curve, place) for place, _ in curve] == pytest.approx(values)
    assert interpolate(curve, curve[0][0] - 1) == curve[0][1]
    assert interpolate(curve, curve[-1][0] + 1) == curve[-1][1]
    (x0, y0), (x1, y1) = curve[:2]
    assert interpolate(curve, (x0 + x1) / 2) == pytest.approx((y0 + y1) / 2)


def fit(minutes: float | None, disk_gb: float | None = None, fixed: tuple[str, ...] = ()) -> Reduction:
    outline = {**make_outline(make_scene(num_frames=360)), "kept": ("disparity", "foreground")}
    return fit_budget(outline, make_survey(), PlanOptions(), MACHINE, minutes, disk_gb, fixed)


def test_less_time_costs_more_error() -> None:
    whole = fit(1e6)
    assert (whole.max_pairs, whole.loss_db, whole.fits) == (None, 0.0, True)
    tighter = [fit(share * whole.minutes) for share in (0.9, 0.7, 0.5)]
    losses = [whole.loss_db, *(reduction.loss_db for reduction in tighter)]
    assert losses == sorted(losses) and losses[-1] > 0
    for share, reduction in zip((0.9, 0.7, 0.5), tighter, strict=True):
        assert not reduction.fits or reduction.minutes <= share * whole.minutes


def test_a_budget_that_cannot_be_kept_says_so() -> None:
    least = fit(0.001)
    assert not least.fits
    assert least.minutes == min(fit(minutes).minutes for minutes in (0.001, 1, 2, 3, 1e6))


def test_every_camera_keeps_a_partner() -> None:
    least = fit(0.001)
    work = choose_work(make_survey(), PAIRS, PlanOptions(max_pairs=least.max_pairs))
    assert {camera for name in work.matched for camera in name.split("-")} == {f"cam0{i}" for i in range(4)}


def test_disk_is_a_budget_too() -> None:
    whole = fit(None, 1e6)
    reduced = fit(None, 0.99 * whole.peak_bytes / 1e9)
    # What only a later change would need goes first.
    assert (whole.kept, reduced.kept) == (("disparity", "foreground"), ("foreground",))
    assert reduced.fits and reduced.loss_db == 0 and reduced.peak_bytes < whole.peak_bytes
    least = fit(None, 1e-6)
    assert not least.fits and least.minutes < whole.minutes


def test_given_numbers_stay() -> None:
    kept = fit(0.001, fixed=("max_pairs", "num_samples", "epochs"))
    outline = make_outline()
    assert (kept.max_pairs, kept.num_samples, kept.epochs) == (
        None,
        outline["num_samples"],
        outline["training"]["epochs"],
    )
    given = {"background": {"num_samples": 5}, "composition": "paper", "plan": {"foreground": "auto"}}
    assert fixed_keys(given) == {"num_samples"}


def test_the_same_budget_gives_the_same_work_whatever_is_finished(tmp_path: Path) -> None:
    assert fit(2.0) == fit(2.0)
    config = {"minutes": None, "disk_gb": None}
    same, reduction = reduce_config(config, {}, tmp_path / "none", tmp_path / "none", ())
    assert (same, reduction) == (config, None)
    # Before the cameras are known there is nothing to choose from.
    config = {"minutes": 3.0, "disk_gb": None}
    assert reduce_config(config, {}, tmp_path / "none", tmp_path / "none", ()) == (config, None)


def test_levels_are_dropped_before_pairs_that_matter() -> None:
    outline = make_outline(make_scene(size=(1920, 1080)), composition={"num_filters": [8, 8, 8]})
    assert outline["num_levels"] == 3

    def fit_levels(minutes: float, *fixed: str) -> Reduction:
        return fit_budget(outline, make_survey(), PlanOptions(), MACHINE, minutes, None, fixed)

    whole, least = fit_levels(1e6), fit_levels(1e-3)
    assert (whole.num_levels, whole.loss_db) == (3, 0.0)
    assert least.num_levels == 1 and not least.fits
    reduced = fit_levels(0.98 * whole.minutes)
    assert (reduced.num_levels, reduced.max_pairs, reduced.epochs) == (2, None, whole.epochs)
    assert reduced.loss_db == pytest.approx(LEVEL_DB)
    assert fit_levels(1e-3, "max_levels").num_levels == 3
    assert apply_reduction(CONFIG, reduced)["max_levels"] == 2


def test_a_training_sample_is_cropped_after_it_was_made_smaller() -> None:
    settings = {"num_filters": [8], "crop": None, "epochs": 1, "min_scale": 0.5, "max_scale": 0.5}
    scene = make_scene(size=(480, 270))
    amounts = {
        crop: list_training(make_outline(scene, composition=settings | {"crop": crop}))[0].amount
        for crop in (None, 192, 100)
    }
    assert amounts[192] / amounts[None] == pytest.approx(192 / 240)
    assert amounts[100] / amounts[None] == pytest.approx(100**2 / (240 * 135))


def test_a_reduction_changes_its_own_keys_only() -> None:
    reduced = apply_reduction(CONFIG, fit(0.001))
    assert reduced["seed"] == 1 and reduced["background"]["fill_px"] == 10
    assert reduced["background"]["num_samples"] == 1
    assert CONFIG["background"]["num_samples"] == 7


def make_plan(budget: dict | None = None, finished: dict | None = None, earlier: dict | None = None) -> dict:
    survey = make_survey(silhouettes="stereo suffices: 4 of 6 pairs are matched")
    outline, work = make_outline(), choose_work(survey, PAIRS, PlanOptions())
    costs = forecast(list_jobs(outline, survey, work), outline["size"], MACHINE, finished or {})
    own = forecast(viewer_jobs(), (240, 135), MACHINE, {})
    viewer = {"size_mb": 19.0, "forecast": own}
    return make_document(outline, survey, work, {"cam09": "too dark"}, budget, costs, viewer, 12, earlier)


def test_the_plan_follows_its_schema_and_says_why() -> None:
    budget = describe_budget({"minutes": 2.0, "disk_gb": None}, fit(2.0))
    document = make_plan(budget)
    check_document({"schema_version": 1, **document})
    text = describe(document)
    for words in (
        "too far apart",
        "too dark",
        "stereo suffices",
        "the films have 270 lines",
        "budget of 2 min",
        "a page of 19 MB by 19 of 19 more jobs",
    ):
        assert words in text, words
    assert all(row["reason"] for row in document["decisions"] if not row["is_made"])
    with pytest.raises(InputError, match=r"disk_now_bytes"):
        check_document({**document, "disk_now_bytes": -1})


def test_of_many_refused_pairs_some_are_printed() -> None:
    document = make_plan()
    row = {"stage": "stereo", "is_made": False, "what": "pair a-b", "reason": "too far", "key": "rectify"}
    many = {**document, "decisions": [{**row, "what": f"pair a-b{i}"} for i in range(20)]}
    text = describe(many)
    assert text.count("too far") == 8 and "and 12 more" in text


def test_the_first_forecast_is_kept_for_the_same_work() -> None:
    first = make_plan()
    finished = {("disparity", PAIRS[0], "samples"): (100.0, 500.0)}
    second = make_plan(finished=finished, earlier=first)
    assert second["first_forecast"] == first["forecast"] != second["forecast"]
    other = make_plan(earlier={**first, "decisions": []})
    assert other["first_forecast"] == other["forecast"]


def test_machine_file(tmp_path: Path) -> None:
    path = tmp_path / "speed.json"
    path.write_text(
        '{"num_cores": 4, "slowness": {"compiled": 1, "vision": 2, "network": 0.5}, "gpu_slowness": null, '
        '"gpu_name": null}'
    )
    assert read_machine_file(path) == Machine(4, {"compiled": 1.0, "vision": 2.0, "network": 0.5})
    path.write_text("{}")
    with pytest.raises(InputError, match="speed of a machine"):
        read_machine_file(path)


def test_units() -> None:
    assert [show_time(s) for s in (12, 300, 7200)] == ["12 s", "5.0 min", "2.0 h"]
    assert [show_size(b) for b in (2e6, 3e9, 4e12)] == ["2 MB", "3.0 GB", "4.0 TB"]
