"""The page: chapters in the order in which a reader asks, one file without any request."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.io import read_image
from fourd.render import list_frames
from fourd.report.current import Current
from fourd.report.films import edit_pictures, edited_views
from fourd.report.html import Child, Markup, figure, join, tag
from fourd.report.numbers import plural, show, show_bytes, show_seconds
from fourd.report.page_costs import cost_chapter, origin_chapter, proof_chapter
from fourd.report.page_films import film_chapter
from fourd.report.page_pictures import picture_chapter
from fourd.report.page_scene import filmed, left_out_chapter, pair_chapter
from fourd.report.page_scores import progress_chapter, score_chapter
from fourd.report.pictures import FrameShow, data_uri
from fourd.report.scores import OURS, Scores, headline_metric, metric_label

FOLDER = Path(__file__).parent
# Nothing may be loaded but what stands in the page and films beside it.
POLICY = (
    "default-src 'none'; img-src data:; media-src 'self' file:; style-src 'unsafe-inline'; "
    "script-src 'unsafe-inline'"
)
CHAPTERS = {
    "filmed": "Footage",
    "pairs": "Pairs",
    "pictures": "Pictures",
    "films": "Films",
    "scores": "Scores",
    "progress": "Error against time",
    "costs": "Cost",
    "proof": "Extreme cases",
    "left-out": "Left out",
    "origin": "How it was made",
}
EVIDENCE = {
    "audio.png": "Clocks from sound: how well the sounds of two films fit, by the delay between them.",
    "offsets.png": "Clocks from sight: votes of moving points for each film's offset.",
}
EVIDENCE_PX = 1400


def draw_page(
    document: Mapping[str, Any],
    scores: Scores | None,
    shows: Sequence[FrameShow],
    evidence: Sequence[tuple[str, np.ndarray]],
    films: Sequence[Markup],
    edits: Sequence[Markup],
    validation: Sequence[tuple[str, np.ndarray]],
    picture_px: int,
) -> str:
    """The whole HTML file. evidence, validation: (sentence, picture) of the clocks and of training;
    films, edits: players and pictures.
    """
    scene = document["scene"]
    cameras = document["cameras"]
    title = f"{scene['name']}: report"
    body = [
        tag(
            "header",
            tag("h1", scene["name"].replace("_", " ")),
            tag(
                "p",
                f"{plural(len(cameras), 'camera')}, {plural(scene['num_frames'], 'frame')} at "
                f"{scene['fps']:.5g} per second, {scene['duration_s']:.3g} s.",
                class_="lead",
            ),
            _facts(document),
            tag("nav", tag("ul", [tag("li", tag("a", t, href=f"#{a}")) for a, t in CHAPTERS.items()])),
        ),
        tag(
            "main",
            filmed(document, [(text, data_uri(image, EVIDENCE_PX)) for text, image in evidence]),
            pair_chapter(document["pairs"]),
            picture_chapter(shows, picture_px),
            film_chapter(document, films, edits),
            score_chapter(document, scores),
            progress_chapter(document, [(text, data_uri(image, EVIDENCE_PX)) for text, image in validation]),
            cost_chapter(document),
            proof_chapter(document),
            left_out_chapter(document),
            origin_chapter(document),
        ),
    ]
    head = join(
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("title", title),
        tag("style", Markup((FOLDER / "page.css").read_text(encoding="utf-8"))),
    )
    script = tag("script", Markup((FOLDER / "page.js").read_text(encoding="utf-8")))
    return "<!doctype html>\n" + tag("html", tag("head", head), tag("body", body, script), lang="en") + "\n"


def _facts(document: Mapping[str, Any]) -> Markup:
    """The few numbers that a reader looks for first."""
    rows = document["scores"]["rows"]
    metric = headline_metric(list(dict.fromkeys(row["metric"] for row in rows)))
    facts = [
        (f"{metric_label(metric)}, {row['region'].replace('_', ' ')}", show(row["mean"], 4))
        for row in rows
        if metric is not None and row["method"] == OURS and row["metric"] == metric
    ][:2]
    used = sum(camera["role"] == "input" for camera in document["cameras"])
    held = sum(camera["role"] == "held out" for camera in document["cameras"])
    good = sum(pair["status"] == "ok" for pair in document["pairs"])
    total = document["costs"]["total"]
    facts += [
        ("cameras used, held out", f"{used}, {held}"),
        ("pairs matched", f"{good} of {len(document['pairs'])}"),
        ("run time", show_seconds(total["run_time_s"])),
        ("on disk", show_bytes(total["num_bytes"])),
    ]
    return tag("dl", [tag("div", tag("dt", name), tag("dd", value)) for name, value in facts], class_="facts")


def read_evidence(results: Path) -> list[tuple[str, np.ndarray]]:
    """Pictures that the clocks were read from, with what they show."""
    paths = {results / "align" / name: text for name, text in EVIDENCE.items()}
    return [(text, read_image(path)) for path, text in paths.items() if path.is_file()]


def read_validation(results: Path, current: Current) -> list[tuple[str, np.ndarray]]:
    """What each level's network made of samples kept apart, at its last epoch, with what it shows."""
    paths = sorted(results.glob("composition/[0-9]/validation.png"))
    paths = [path for path in paths if current.has_level(path.parent.name)]
    text = "samples kept apart: what is pasted, what the network makes of it, what the camera filmed."
    return [(f"Level {path.parent.name}, {text}", read_image(path)) for path in paths]


def film_players(results: Path, current: Current, output: Path, picture_px: int) -> list[Markup]:
    """Players of the scene's films, which stay beside the page; each shows one frame until it is started."""
    players = []
    for name in current.views:
        path = results / "render" / f"{name}.mp4"
        if path.is_file():
            caption = [tag("b", name.replace("_", " ")), " ", f"film {path.name}"]
            folders = current.chunks_in(results / "render" / name, name)
            players.append(_player(path, folders, caption, output, picture_px))
    return players


def _player(
    path: Path, folders: Sequence[Path], caption: Sequence[Child], output: Path, picture_px: int
) -> Markup:
    images = list(list_frames(folders).values())
    poster = data_uri(read_image(images[len(images) // 2]), picture_px) if images else None
    source = Path(os.path.relpath(path, output)).as_posix()
    return figure(tag("video", src=source, poster=poster, controls=True, preload="none"), caption)


def edit_shows(results: Path, current: Current, output: Path, picture_px: int) -> list[Markup]:
    """What every edit changed most in every view: the picture, where its pixels come from, and the film."""
    shows = []
    for folder, view in edited_views(results, current):
        found = edit_pictures(folder, view, current)
        if found is None:
            continue
        frame, edited, painted = found
        title = f"{folder.parent.name.replace('_', ' ')}, {view}"
        pictures = (
            (edited, f"frame {frame}, edited"),
            (painted, "where its pixels come from; grey is untouched"),
        )
        thumbs = [
            figure(tag("img", src=data_uri(image, picture_px), alt=f"{title}: {text}"), text)
            for image, text in pictures
        ]
        film = folder.with_suffix(".mp4")
        folders = current.chunks_in(folder, view)
        player = _player(film, folders, [f"film {film.name}"], output, picture_px) if film.is_file() else None
        shows.append(tag("article", tag("h3", title), tag("div", thumbs, player, class_="grid")))
    return shows
