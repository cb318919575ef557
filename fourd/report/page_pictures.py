"""The chapter of pictures: chosen frames through all stages, truth and render under a slider."""

from collections.abc import Sequence

from fourd.report.html import Markup, figure, section, tag
from fourd.report.pictures import FrameShow, Picture, data_uri


def picture_chapter(shows: Sequence[FrameShow], picture_px: int) -> Markup:
    """Chosen frames through all stages."""
    return section(
        "pictures",
        "Pictures of every stage",
        "The way from footage to film for the worst, a middling and the best frame. Good: truth and render "
        "differ at edges only, and the error is black but for fine texture.",
        [_frame(shown, picture_px) for shown in shows]
        or tag("p", "No frame has been rendered yet.", class_="none"),
    )


def _frame(shown: FrameShow, picture_px: int) -> Markup:
    title = f"{shown.view}, frame {shown.frame}"
    big = 2 * picture_px
    slider = None
    pictures = list(shown.pictures)
    if shown.truth is not None and shown.rendered is not None:
        slider = _slider(title, data_uri(shown.truth, big), data_uri(shown.rendered, big))
        pictures = [p for p in pictures if p.title != "render"]
    gone = [p for p in pictures if p.image is None]
    return tag(
        "article",
        tag("h3", title, " ", tag("small", shown.why)),
        slider,
        tag("div", [_thumb(p, picture_px) for p in pictures if p.image is not None], class_="grid"),
        [tag("p", f"{_names(gone, reason)}: {reason}.", class_="none") for reason in _unique(gone)],
    )


def _unique(gone: Sequence[Picture]) -> list[str]:
    return list(dict.fromkeys(p.caption for p in gone))


def _names(gone: Sequence[Picture], reason: str) -> str:
    return "No picture of " + ", ".join(p.title for p in gone if p.caption == reason)


def _thumb(picture: Picture, picture_px: int) -> Markup | None:
    if picture.image is None:
        return None
    image = tag("img", src=data_uri(picture.image, picture_px), alt=f"{picture.title}: {picture.caption}")
    return figure(image, [tag("b", picture.title), " ", picture.caption])


def _slider(title: str, truth: str, rendered: str) -> Markup:
    """Both pictures on each other; without scripts beside each other. Keys and touch move the range too."""
    return figure(
        tag(
            "div",
            tag("div", tag("img", src=truth, alt=f"truth, {title}"), tag("span", "truth"), class_="before"),
            tag(
                "div", tag("img", src=rendered, alt=f"render, {title}"), tag("span", "render"), class_="after"
            ),
            tag(
                "input",
                type="range",
                min=0,
                max=100,
                value=50,
                aria_label=f"{title}: how much of the truth is shown, the rest is the render",
            ),
            class_="compare",
        ),
        "Left of the line is what the camera filmed, right of it what was made without it. Move the line by "
        "dragging or with the arrow keys.",
    )
