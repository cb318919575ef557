"""Chapters on the footage: cameras, clocks, calibration, pairs, and what was left out."""

from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

from fourd.report.charts import bar_chart
from fourd.report.html import Markup, figure, more, section, table, tag
from fourd.report.map import draw_map
from fourd.report.numbers import plural, show

Document = Mapping[str, Any]


def filmed(document: Document, evidence: Sequence[tuple[str, str]]) -> Markup:
    """What was filmed. evidence: (sentence, data URI) of the pictures that the clocks were read from."""
    scene = document["scene"]
    scene_map = document["map"]
    signs = {
        "dot input": "camera that the films are made from",
        "dot held": "camera held out to check them",
        "dash walk": "way of a moving camera",
        "dash flight": "way of a film",
    }
    shown = {"dot input"}
    shown |= {"dot held" for c in scene_map["cameras"] if c["role"] == "held out"}
    shown |= {"dash walk" for c in scene_map["cameras"] if len(c["path"]) > 1}
    shown |= {"dash flight" for t in scene_map["trajectories"] if len(t["path"]) > 1}
    items = [tag("li", tag("span", class_=sign), text) for sign, text in signs.items() if sign in shown]
    key = tag("ul", items, class_="legend")
    return section(
        "filmed",
        "What was filmed",
        "Where the cameras stood, how well their clocks and positions are known. Good: clocks within a "
        "quarter of a frame, static points within half a pixel, neighbours 5 to 30 degrees apart.",
        figure(
            [draw_map(scene_map, scene["metres_per_unit"]), key],
            "The cameras from above; the cameras look up the page on average. Grey dots are static points."
            + (
                ""
                if scene["metres_per_unit"]
                else " The size of the world is not known, so there is no scale."
            ),
        ),
        _camera_table(document["cameras"]),
        _clock_table(document),
        more(
            "The evidence of the clocks",
            [figure(tag("img", src=uri, alt=text), text) for text, uri in evidence],
        )
        if evidence
        else None,
        _residuals(document["cameras"]),
        _against_truth(document),
    )


def _camera_table(cameras: Sequence[Document]) -> Markup:
    rows = [
        (
            c["name"],
            c["role"],
            "{} x {}".format(*c["size"]) if c["size"] else "-",
            "-" if c["fps"] is None else f"{c['fps']:.5g}",
            c["num_source_frames"] or "-",
            "moves" if c["is_moving"] else "still",
            c["device"] or "-",
        )
        for c in cameras
    ]
    header = ("camera", "role", "pixels", "fps", "frames", "pose", "device")
    return table(header, rows, "Cameras")


def _clock_table(document: Document) -> Markup:
    fps = document["scene"]["fps"]
    cameras = [c for c in document["cameras"] if c["offset_s"] is not None]
    if not cameras:
        return tag("p", "The clocks were not looked for.", class_="none")
    if all(c["clock_method"] == "given" for c in cameras):
        return tag(
            "p", "The clocks were given with the scene, so there is no evidence to show.", class_="none"
        )

    def in_frames(seconds: float | None) -> str:
        return "-" if seconds is None else show(seconds * fps, 2)

    rows = [
        (
            c["name"],
            c["clock_method"] or "-",
            f"{c['offset_s'] * 1e3:.1f}",
            "-" if c["sigma_s"] is None else f"{c['sigma_s'] * 1e3:.1f}",
            in_frames(c["sigma_s"]),
            in_frames(c["largest_dt_s"]),
        )
        for c in cameras
    ]
    header = ("camera", "from", "offset, ms", "sigma, ms", "sigma, frames", "picture off by, frames")
    return table(header, rows, "Clocks: common time of each film's first frame", range(2, 6))


def _residuals(cameras: Sequence[Document]) -> Markup:
    known = [c for c in cameras if c["reprojection_error_px"] is not None]
    if not known:
        return tag("p", "The calibration was given or has no residuals to show.", class_="none")
    errors = [(c["name"], c["reprojection_error_px"]) for c in known]
    chart = bar_chart([(name, v, f"{show(v, 2)} px") for name, v in errors], "Reprojection error by camera")
    return figure(chart, "How far static points lie from where each camera saw them, root mean square.")


def _against_truth(document: Document) -> Markup | None:
    """Recovered cameras and clocks against true ones."""
    truth = document["truth"]
    if truth is None:
        return None
    fps = document["scene"]["fps"]
    clocks = {row["name"]: row["error_s"] for row in truth["clocks"]}
    cameras = {row["name"]: row for row in truth["cameras"]}
    rows = []
    for name in dict.fromkeys([*cameras, *clocks]):
        row, error_s = cameras.get(name, {}), clocks.get(name)
        shares = [row.get(key) for key in ("center_share", "focal_share")]
        rows.append(
            (
                name,
                show(row.get("rotation_deg"), 2),
                show(row.get("center"), 2),
                *("-" if share is None else f"{share:.3%}" for share in shares),
                "-" if error_s is None else f"{error_s * 1e3:+.1f}",
                "-" if error_s is None else f"{error_s * fps:+.2f}",
            )
        )
    header = (
        "camera",
        "turned by, deg",
        "centre off by",
        "of the distance",
        "focal length",
        "clock, ms",
        "clock, frames",
    )
    if not rows:
        return tag("p", "True cameras were given, but none of them was recovered.", class_="none")
    return table(
        header,
        rows,
        "Against the truth: poses after the best similarity of the two worlds, in the true world's units, "
        "clocks after the best shift",
        range(1, 7),
    )


def _how(pair: Document) -> Markup:
    if pair["status"] != "ok":
        return tag("span", tag("b", "left out: "), pair["status"], class_="reason")
    words = pair["kind"] or "matched"
    return tag("span", f"{words}: {pair['obstacle']}" if pair["obstacle"] else words, class_="reason")


def pair_chapter(pairs: Sequence[Document]) -> Markup:
    """Every pair of input cameras with how it is matched or why it is not."""
    good = [pair for pair in pairs if pair["status"] == "ok"]
    rows = [
        (
            p["pair"],
            _how(p),
            show(p["angle_deg"], 3),
            "-" if p["overlap"] is None else f"{p['overlap']:.0%}",
            "-" if p["depth_error"] is None else f"{p['depth_error']:.2%}",
        )
        for p in pairs
    ]
    return section(
        "pairs",
        "Pairs of cameras",
        f"Depth comes from {len(good)} of {plural(len(pairs), 'pair')}; a pair that cannot be matched says "
        "why. Good: every camera is in at least two pairs, seen 5 to 30 degrees apart.",
        table(
            ("pair", "how, or why not", "angle, deg", "overlap", "depth error to expect"),
            rows,
            "Pairs",
            range(2, 5),
        )
        if pairs
        else tag("p", "There are no pairs: one camera, or depth was given.", class_="none"),
    )


def left_out_chapter(document: Document) -> Markup:
    """Everything that is not in the result, one line per reason."""
    entries = [entry for entry in document["left_out"] if entry["kind"] != "pair"]
    lines: list[Sequence[Markup | str]] = []
    for (kind, reason), group in groupby(
        sorted(entries, key=lambda e: (e["kind"], e["reason"], e["name"])), lambda e: (e["kind"], e["reason"])
    ):
        names = [entry["name"] for entry in group]
        shown = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
        lines.append((kind, shown, tag("span", reason, class_="reason")))
    if num_pairs := len(document["left_out"]) - len(entries):
        why = tag("a", "each with its reason in the table of pairs", href="#pairs")
        lines.append(("pair", str(num_pairs), tag("span", why, class_="reason")))
    holes = [
        (
            r["view"],
            r["level"],
            r["num_frames"],
            f"{r['mean_hole_share']:.2%}",
            f"{r['max_hole_share']:.2%}",
            f"{r['mean_filled_share']:.2%}",
            tag(
                "span",
                "; ".join(f"{reason} ({count})" for reason, count in r["reasons"].items()),
                class_="reason",
            ),
        )
        for r in document["renders"]
    ]
    header = (
        "view",
        "level",
        "frames",
        "blank, mean",
        "blank, worst",
        "from a coarser level",
        "why (frames)",
    )
    return section(
        "left-out",
        "What was left out, and why",
        "What did not make it into the films, and where they had nothing to go by. Good: no camera, few "
        "pairs, blank pixels below 2 %.",
        table(("what", "which", "why"), lines, "Left out")
        if lines
        else tag("p", "Nothing was left out.", class_="none"),
        table(header, holes, "Pixels that neither foreground nor background knows", range(2, 6))
        if holes
        else None,
        more(
            f"Warnings ({len(document['warnings'])})", tag("ul", [tag("li", w) for w in document["warnings"]])
        )
        if document["warnings"]
        else tag("p", "There are no warnings.", class_="none"),
    )
