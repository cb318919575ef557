"""Tables that are there only if they were asked for: extreme cases, and sweeps against truth."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.io import read_csv
from fourd.report.numbers import finite, parse

# What a sweep measures; the other columns of its table are its settings.
MEASURED = ("error", "seconds", "cpu_seconds", "peak_rss_mb")


def collect_stability(path: Path | None) -> dict[str, Any] | None:
    """Counts of verdicts by group and every case of stability.csv, None if the suite has not been run."""
    if path is None or not path.is_file():
        return None
    rows = read_csv(path)
    groups: dict[str, dict[str, int]] = {}
    for row in rows:
        counts = groups.setdefault(row["group"], {})
        counts[row["verdict"]] = counts.get(row["verdict"], 0) + 1
    keys = ("group", "case", "expected", "got", "verdict")
    return {
        "groups": [{"group": name, "verdicts": counts} for name, counts in groups.items()],
        "cases": [{key: row.get(key, "") for key in keys} for row in rows],
    }


def collect_benches(folder: Path | None) -> list[dict[str, Any]]:
    """Every table below `folder` that has errors and times: its rows by name, and those that none beats."""
    if folder is None or not folder.is_dir():
        return []
    benches = []
    for path in sorted(folder.rglob("*.csv")):
        rows = read_csv(path)
        time = next((key for key in ("cpu_seconds", "seconds") if rows and key in rows[0]), None)
        if time is None or "error" not in rows[0]:
            continue
        settings = [key for key in rows[0] if key not in MEASURED]
        settings = settings[: 1 if "setting" in settings[:1] else 3]
        points = [
            {
                "name": _name(row, settings),
                "error": finite(parse(row["error"])),
                "seconds": finite(parse(row[time])),
            }
            for row in rows
        ]
        points = [p for p in points if p["error"] is not None and p["seconds"] is not None]
        benches.append(
            {
                "bench": path.stem,
                "time": time,
                "points": points,
                "front": find_front([(p["seconds"], p["error"]) for p in points]),
            }
        )
    return benches


def _name(row: Mapping[str, str], settings: Sequence[str]) -> str:
    if settings == ["setting"]:
        return row["setting"]
    return ", ".join(f"{key} {row[key]}" if parse(row[key]) is not None else row[key] for key in settings)


def collect_ablations(folder: Path) -> list[dict[str, Any]]:
    """Every table of a scene's ablations as it is, and the mean score of each variant by its seconds.

    The scores are those at the last `mark_s` (training seconds) of a variant, means over its views.
    """
    tables = []
    for path in sorted(folder.glob("*.csv")):
        rows = read_csv(path)
        columns = list(rows[0]) if rows else []
        cells = [[_cell(text) for text in row.values()] for row in rows]
        metric = next((name for name in columns if "psnr" in name), None)
        points = []
        if metric is not None and {"variant", "seconds"} <= set(columns):
            points = _variant_points(rows, metric)
        tables.append(
            {"name": path.stem, "columns": columns, "rows": cells, "metric": metric, "points": points}
        )
    return tables


def _cell(text: str) -> str | float | None:
    number = parse(text)
    return text if number is None else finite(number)


def _variant_points(rows: Sequence[Mapping[str, str]], metric: str) -> list[dict[str, Any]]:
    points = []
    for variant in dict.fromkeys(row["variant"] for row in rows):
        own = [row for row in rows if row["variant"] == variant]
        last = max(parse(row.get("mark_s")) or 0.0 for row in own)
        own = [row for row in own if (parse(row.get("mark_s")) or 0.0) == last]
        values, seconds = ([finite(parse(row[key])) for row in own] for key in (metric, "seconds"))
        known = [(v, s) for v, s in zip(values, seconds, strict=True) if v is not None and s is not None]
        if known:
            value, time = (sum(column) / len(known) for column in zip(*known, strict=True))
            points.append({"name": variant, "value": value, "seconds": time})
    return points


def find_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (seconds, error) that no other beats in both, by rising seconds."""
    front: list[int] = []
    for i in sorted(range(len(points)), key=lambda i: (points[i], i)):
        if not front or points[i][1] < points[front[-1]][1]:
            front.append(i)
    return front
