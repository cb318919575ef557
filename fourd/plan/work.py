"""What is left to do once the cameras are known: pure decisions, each with its reason."""

import dataclasses
from collections.abc import Mapping, Sequence

from fourd.errors import InputError
from fourd.plan.options import USES, PlanOptions

OK = "ok"
STILL = "nothing in it moves by itself"
"""How stage align begins the status of a film without motion."""


@dataclasses.dataclass(frozen=True)
class PairFacts:
    """What a rectification says. status: `ok`, or why the pair cannot be matched; angle_deg: None if unknown.

    kind: `planar`, `sweep` or None;  size: (width, height) of the rectified images, px
    num_disparities: width of the search, px, None if unknown
    """

    status: str
    kind: str | None = None
    angle_deg: float | None = None
    size: tuple[int, int] = (0, 0)
    num_disparities: float | None = None


@dataclasses.dataclass(frozen=True)
class Survey:
    """What is known once the cameras are (docs/formats.md, `plan/survey.json`).

    pairs: LEFT-RIGHT -> facts, in the scene's order;  silhouettes: `ok`, or why none are made
    motion: input camera -> status of its motion map, empty where no film was looked at
    """

    pairs: Mapping[str, PairFacts]
    silhouettes: str
    motion: Mapping[str, str]


@dataclasses.dataclass(frozen=True)
class Work:
    """What is made: pair, `foreground` and `silhouettes` -> `ok`, or the reason against it."""

    pairs: Mapping[str, str]
    foreground: str
    silhouettes: str

    @property
    def matched(self) -> list[str]:
        """Pairs that are matched, in the scene's order."""
        return [name for name, status in self.pairs.items() if status == OK]


def choose_work(survey: Survey | None, pairs: Sequence[str], options: PlanOptions) -> Work:
    """The decisions that the job graph follows.

    survey: None before the cameras are known: then all that might be needed is made
    pairs: names of all pairs of input cameras; one that the survey does not know is taken for a good one
    Raises InputError for settings that name no pair, or nothing that can be.
    """
    if options.foreground not in USES:
        raise InputError(
            f"expected plan foreground among {', '.join(USES)}, got {options.foreground!r}: correct it"
        )
    unknown = sorted(set(options.leave_out_pairs) - set(pairs))
    if unknown:
        raise InputError(
            f"plan leave_out_pairs names {', '.join(unknown)}, which is no pair of input cameras: "
            f"pairs are LEFT-RIGHT in the scene's order, such as {pairs[0]}"
        )
    known = survey.pairs if survey else {}
    facts = {name: known.get(name, PairFacts(OK)) for name in pairs}
    statuses = {name: fact.status for name, fact in facts.items()}
    for name in options.leave_out_pairs:
        if statuses[name] == OK:
            statuses[name] = "left out by the configuration (plan leave_out_pairs)"
    # Which pairs are useful is not known before their angles are.
    if options.max_pairs is not None and survey is not None:
        ranked = rank_pairs({name: facts[name] for name, status in statuses.items() if status == OK})
        for name in ranked[options.max_pairs :]:
            statuses[name] = f"one of the least useful: {options.max_pairs} are matched (plan max_pairs)"
    return Work(
        statuses,
        judge_foreground(survey.motion if survey else {}, options),
        survey.silhouettes if survey else OK,
    )


def judge_foreground(motion: Mapping[str, str], options: PlanOptions) -> str:
    """`ok`, or why no instantaneous foreground is made.

    motion: input camera -> status of its motion map
    """
    if options.foreground == "never":
        return "left out by the configuration (plan foreground)"
    still = bool(motion) and all(status.startswith(STILL) for status in motion.values())
    if options.foreground == "auto" and still:
        return f"nothing moves by itself in any of {len(motion)} films"
    return OK


def rank_pairs(pairs: Mapping[str, PairFacts]) -> list[str]:
    """Pairs that can be matched, the most useful first.

    Next comes a pair of the camera that has the fewest so far, and of these the one with the smallest angle:
    near views are matched on more of their pixels, and no camera is left without a partner.
    """
    rest = dict(pairs)
    count = {camera: 0 for name in pairs for camera in name.split("-")}
    ranked = []
    while rest:

        def need(name: str) -> tuple[int, int, float, str]:
            fewest, other = sorted(count[camera] for camera in name.split("-"))
            angle = rest[name].angle_deg
            return fewest, other, float("inf") if angle is None else angle, name

        best = min(rest, key=need)
        ranked.append(best)
        del rest[best]
        for camera in best.split("-"):
            count[camera] += 1
    return ranked
