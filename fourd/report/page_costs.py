"""Chapters on cost and trust: time and memory, extreme cases, sweeps, how the run can be repeated."""

import json
from collections.abc import Mapping
from typing import Any

from fourd.report.charts import bar_chart, scatter_chart
from fourd.report.extras import find_front
from fourd.report.html import Markup, figure, join, more, section, table, tag
from fourd.report.numbers import plural, show, show_bytes, show_seconds
from fourd.report.scores import metric_label

Document = Mapping[str, Any]


def cost_chapter(document: Document) -> Markup:
    """Seconds, processor seconds, memory and disk by stage and by rule."""
    costs = document["costs"]
    stages, total = costs["stages"], costs["total"]
    rows = [
        (
            s["stage"],
            s["num_jobs"],
            show_seconds(s["seconds"]),
            show_seconds(s["cpu_seconds"]),
            show_seconds(s["cumulative_cpu_seconds"]),
            show_bytes(s["peak_bytes"]),
            show_bytes(s["num_bytes"]),
        )
        for s in stages
    ]
    rows.append(
        (
            tag("b", "all"),
            total["num_jobs"],
            show_seconds(total["seconds"]),
            show_seconds(total["cpu_seconds"]),
            show_seconds(total["cpu_seconds"]),
            show_bytes(total["peak_bytes"]),
            show_bytes(total["num_bytes"]),
        )
    )
    header = ("stage", "jobs", "job time", "processor time", "so far", "most memory", "disk")
    busy = [s for s in stages if s["cpu_seconds"] > 0]
    chart = bar_chart(
        [(s["stage"], s["cpu_seconds"], show_seconds(s["cpu_seconds"])) for s in busy],
        "Processor time by stage",
    )
    by_rule = table(
        ("rule", "jobs", "job time", "processor time", "most memory", "done at"),
        [
            (
                r["rule"],
                r["num_jobs"],
                show_seconds(r["seconds"]),
                show_seconds(r["cpu_seconds"]),
                show_bytes(r["peak_bytes"]),
                show_seconds(r["done_at_s"]),
            )
            for r in costs["rules"]
        ],
        "Every rule, and the run time at which its last job was done",
        range(1, 6),
    )
    return section(
        "costs",
        "Time, memory and disk",
        f"The run took {show_seconds(total['run_time_s'])} on the clock, pauses left out, and "
        f"{show_seconds(total['cpu_seconds'])} of processor time. Good: most of it goes into matching, "
        "background and training.",
        figure(chart, "Processor time by stage, in the order of the flow.") if busy else None,
        table(header, rows, "Stages in the order of the flow", range(1, 7)),
        _forecast(document["forecast"]),
        more("By rule", by_rule),
    )


def _forecast(forecast: Document | None) -> Markup:
    """What was foreseen against what it took."""
    if forecast is None:
        return tag("p", "No forecast was made before the run (snakemake plan).", class_="none")
    known = [rule for rule in forecast["rules"] if rule["cpu_s"] is not None]
    total = {key: sum(rule[key] for rule in known) for key in ("forecast_cpu_s", "cpu_s")}
    rows = [
        (
            rule["rule"],
            f"{rule['num_jobs']} of {rule['num_jobs_forecast']}",
            show_seconds(rule["forecast_cpu_s"]),
            show_seconds(rule["cpu_s"]),
        )
        for rule in forecast["rules"]
    ]
    rows.append(("all that ran", "", show_seconds(total["forecast_cpu_s"]), show_seconds(total["cpu_s"])))
    whole = table(
        ("rule", "jobs", "forecast", "took"), rows, "Processor time, forecast and actual", range(1, 4)
    )
    text = (
        f"Before the run {forecast['minutes']:.1f} minutes on {plural(forecast['num_cores'], 'core')} were "
        f"foreseen. Of the rules that ran, {show_seconds(total['forecast_cpu_s'])} of processor time were "
        f"foreseen and {show_seconds(total['cpu_s'])} taken."
    )
    return join(tag("p", text), more("Forecast and actual by rule", whole))


def proof_chapter(document: Document) -> Markup:
    """Extreme cases and sweeps, where they have been run."""
    stability = document["stability"]
    if stability is None:
        suite: list[Markup] = [
            tag("p", "The extreme cases have not been run (snakemake stability).", class_="none")
        ]
    else:
        verdicts = list(dict.fromkeys(v for g in stability["groups"] for v in g["verdicts"]))
        rows = [(g["group"], *(g["verdicts"].get(v, 0) for v in verdicts)) for g in stability["groups"]]
        cases = [
            (c["group"], c["case"], c["verdict"], tag("span", c["got"], class_="reason"))
            for c in stability["cases"]
        ]
        suite = [
            table(("group", *verdicts), rows, "Extreme cases by group", range(1, 9)),
            more(
                plural(len(cases), "case"),
                table(("group", "case", "verdict", "what happened"), cases, "Every case"),
            ),
        ]
    benches = [_bench(bench) for bench in document["benches"]]
    none = tag("p", "No sweeps have been run (snakemake bench_fuse bench_background).", class_="none")
    return section(
        "proof",
        "Extreme cases and sweeps",
        "How the code behaves at its edges, and what each setting costs. Good: no case is bad, and the "
        "defaults lie on the line.",
        suite,
        benches or none,
        [_ablations(one) for one in document["ablations"]],
    )


def _bench(bench: Document) -> Markup:
    """One sweep: all settings, and those that no other beats by number."""
    points, front = bench["points"], bench["front"]
    numbers = {index: str(i + 1) for i, index in enumerate(front)}
    title = bench["bench"].replace("_", " ")
    time = bench["time"].replace("_", " ")
    chart = scatter_chart(
        [(numbers.get(i, ""), p["seconds"], p["error"]) for i, p in enumerate(points)],
        front,
        f"{time} (logarithmic)",
        "error (logarithmic)",
        f"Error against time of the settings of {title}",
        is_log=True,
    )
    rows = [
        (numbers[i], points[i]["name"], show(points[i]["seconds"]), show(points[i]["error"])) for i in front
    ]
    text = (
        f"{title}: {plural(len(points), 'setting')}; no other beats those on the line in both time and error."
    )
    return figure([chart, table(("", "setting", time, "error"), rows, f"On the line: {title}", (2, 3))], text)


def _ablations(one: Document) -> Markup:
    rows = [[show(c, 4) if isinstance(c, float | int) else c for c in row] for row in one["rows"]]
    title = f"Ablations: {one['name'].replace('_', ' ')}"
    whole = more(title, table(one["columns"], rows, title, range(1, len(one["columns"]))))
    if not one["points"]:
        return whole
    front = find_front([(p["seconds"], -p["value"]) for p in one["points"]])
    chart = scatter_chart(
        [(p["name"], p["seconds"], p["value"]) for p in one["points"]],
        front,
        "seconds",
        metric_label(one["metric"]),
        f"{title}, score against time",
    )
    text = f"{title}: what each variant reaches with its time; no other beats those on the line."
    return join(figure(chart, text), whole)


def origin_chapter(document: Document) -> Markup:
    """Versions, seeds, settings and command."""
    environment = document["environment"]
    versions = {"Python": environment["python"], **environment["packages"]}
    settings = environment["settings"]
    return section(
        "origin",
        "How this was made",
        "What is needed to get the same again. Good: all of it is here; on one kind of processor the same "
        "settings then give the same bytes.",
        tag("h3", "Command"),
        tag("pre", environment["command"] or "not recorded: the page was made outside the workflow"),
        tag("h3", "Seeds"),
        tag(
            "p",
            ", ".join(f"{name} = {seed}" for name, seed in environment["seeds"].items()) or "not recorded",
        ),
        more(
            f"Versions, on {environment['system']} with {plural(environment['num_cores'] or 1, 'core')}",
            table(
                ("package", "version"), [(k, v or "not installed") for k, v in versions.items()], "Versions"
            ),
        ),
        more("Settings, defaults filled in", tag("pre", json.dumps(settings, indent=1)))
        if settings
        else tag("p", "The settings were not recorded.", class_="none"),
    )
