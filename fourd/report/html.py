"""HTML from functions: text is escaped unless it is already `Markup`."""

import html
from collections.abc import Container, Iterable, Sequence

VOID_TAGS = frozenset({"img", "input", "meta", "br", "line", "path", "circle", "rect", "polyline", "polygon"})


class Markup(str):
    """Text that is HTML already and is not escaped again."""


Child = str | int | float | None | Iterable["Child"]


def render_children(children: Iterable[Child]) -> str:
    """The children's HTML: `Markup` as it is, other text escaped, None left out, lists flattened."""
    parts = []
    for child in children:
        if child is None:
            continue
        if isinstance(child, Markup):
            parts.append(str(child))
        elif isinstance(child, str | int | float):
            parts.append(html.escape(str(child)))
        else:
            parts.append(render_children(child))
    return "".join(parts)


def tag(name: str, /, *children: Child, **attributes: str | int | float | bool | None) -> Markup:
    """One element. `class_` and `aria_label` become `class` and `aria-label`; None and False are left out."""
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip("_").replace("_", "-")
        words.append(key if value is True else f'{key}="{html.escape(str(value))}"')
    opening = " ".join(words)
    # A void element has no children; SVG shapes are closed at once, which HTML allows too.
    if name in VOID_TAGS and not children:
        return Markup(f"<{opening}/>")
    return Markup(f"<{opening}>{render_children(children)}</{name}>")


def join(*children: Child) -> Markup:
    """Several elements beside each other."""
    return Markup(render_children(children))


def table(
    header: Sequence[Child],
    rows: Iterable[Sequence[Child]],
    caption: str,
    numeric: Container[int] = range(0),
) -> Markup:
    """A table with its title, in a box of its own that scrolls; the columns in `numeric` are set right."""

    def cells(row: Sequence[Child], name: str) -> list[Markup]:
        kinds = ["num" if i in numeric else None for i in range(len(row))]
        if name == "td" and row:
            first = tag("th", row[0], scope="row", class_=kinds[0])
            return [first, *(tag("td", c, class_=k) for c, k in zip(row[1:], kinds[1:], strict=True))]
        return [tag(name, c, scope="col", class_=k) for c, k in zip(row, kinds, strict=True)]

    head = tag("thead", tag("tr", cells(header, "th")))
    body = tag("tbody", [tag("tr", cells(row, "td")) for row in rows])
    # The title stands outside, so that it does not scroll away; the box must be reachable by keyboard.
    return join(
        tag("p", caption, class_="caption"),
        tag("div", tag("table", head, body), class_="scroll", tabindex=0, role="region", aria_label=caption),
    )


def figure(content: Child, caption: Child) -> Markup:
    """Something to look at, with what it shows in plain words below it."""
    return tag("figure", content, tag("figcaption", caption))


def section(anchor: str, title: str, lead: Child, *content: Child) -> Markup:
    """A chapter: its title, one sentence on what it shows and what is good, and what follows."""
    return tag("section", tag("h2", title), tag("p", lead, class_="lead"), *content, id=anchor)


def more(summary: str, *content: Child) -> Markup:
    """Something that is folded away until asked for."""
    return tag("details", tag("summary", summary), *content)
