"""Settings of the stage."""

import dataclasses

ESTIMATES = ("farthest", "median")


@dataclasses.dataclass(frozen=True)
class BackgroundOptions:
    """Settings of the stage.

    num_samples: scene frames that vote, spread evenly over those in the disparity files
    persistence: share of the sampled times that have to show a surface for it to hide all behind it
    fill_px: widest hole that is closed from what is known on both sides of it
    """

    num_samples: int = 7
    persistence: float = 0.8
    fill_px: int = 10
