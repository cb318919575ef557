"""The chapter of films and edits: where a film leaves the cameras, where edited pixels come from."""

from collections.abc import Mapping, Sequence
from typing import Any

from fourd.report.films import ORIGINS
from fourd.report.html import Markup, join, section, table, tag
from fourd.report.numbers import show

Document = Mapping[str, Any]


def film_chapter(document: Document, films: Sequence[Markup], edits: Sequence[Markup]) -> Markup:
    """films: players;  edits: pictures of what was edited"""
    none = tag("p", "No film has been made yet.", class_="none")
    return section(
        "films",
        "Films",
        "What was made, and where it is filmed from. Good: no frame outside the cameras; there nobody saw "
        "what the picture shows.",
        tag("div", films, class_="films") if films else none,
        _place_table(document["films"]),
        _edit_table(document["edits"]),
        edits,
    )


def _place_table(films: Sequence[Document]) -> Markup | None:
    if not films:
        return None
    rows = [
        (
            film["name"].replace("_", " "),
            film["num_frames"],
            film["num_outside"],
            show(film["max_distance_spacings"], 2),
            show(film["max_turn_deg"], 3),
            tag("span", "; ".join(map(_describe_run, film["outside"])) or "-", class_="reason"),
        )
        for film in films
    ]
    header = (
        "film",
        "frames",
        "outside",
        "farthest from the hull, spacings",
        "most turned away, deg",
        "frames outside, and why",
    )
    title = "Where the films are filmed from: the hull of the cameras, and the spacing of neighbours"
    return table(header, rows, title, range(1, 5))


def _describe_run(run: Document) -> str:
    frames = str(run["first"]) if run["first"] == run["last"] else f"{run['first']} to {run['last']}"
    return f"{frames}: {run['reason']}"


def _edit_table(edits: Sequence[Document]) -> Markup | None:
    if not edits:
        return None
    rows = [
        (
            edit["edit"].replace("_", " "),
            edit["view"],
            edit["num_frames"],
            *(f"{edit[key]:.2%}" for key in ("changed_share", *ORIGINS)),
        )
        for edit in edits
    ]
    keys = [
        tag(
            "li",
            tag("span", class_="swatch", style="background:rgb({} {} {})".format(*colour)),
            f"{key.replace('_', ' ')}: {text}",
        )
        for key, (text, colour) in ORIGINS.items()
    ]
    title = "Edits: pixels that were changed, and where what is there now comes from, means over the frames"
    return join(
        table(
            ("edit", "view", "frames", "changed", *(key.replace("_", " ") for key in ORIGINS)),
            rows,
            title,
            range(2, 9),
        ),
        tag("ul", keys, class_="legend"),
    )
