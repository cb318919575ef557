"""Settings of the stage."""

import dataclasses
from collections.abc import Mapping
from typing import Any

USES = ("auto", "always", "never")


@dataclasses.dataclass(frozen=True)
class PlanOptions:
    """Settings of the plan (section `plan`); each takes one of its decisions out of its hands.

    foreground: auto leaves it out where nothing moves by itself in any film; always; never
    leave_out_pairs: pairs LEFT-RIGHT that are not matched though they could be
    max_pairs: at most this many pairs are matched, the most useful ones; None: all that can be
    """

    foreground: str = "auto"
    leave_out_pairs: tuple[str, ...] = ()
    max_pairs: int | None = None


def options_from_section(section: Mapping[str, Any]) -> PlanOptions:
    """The settings from the section of a checked configuration."""
    return PlanOptions(**{**section, "leave_out_pairs": tuple(section["leave_out_pairs"])})
