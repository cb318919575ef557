"""Extreme cases of every stage: the right answer or a refusal that names the cause.

One module per group of cases, each with its `CASES`; `python -m fourd.stability` runs them all.
"""

from fourd.stability.case import Case

STAGE_VERSION = 1


def all_cases() -> tuple[Case, ...]:
    """Every case of the suite, in the order of the table."""
    # Importing the cases imports every stage.
    from fourd.stability import (
        background,
        cameras,
        clocks,
        fusion,
        geometry,
        learning,
        matching,
        pictures,
        scale,
    )

    groups = (pictures, clocks, cameras, geometry, matching, fusion, background, scale, learning)
    return tuple(case for group in groups for case in group.CASES)


__all__ = ["STAGE_VERSION", "all_cases"]
