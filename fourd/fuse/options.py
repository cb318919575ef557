"""Settings of the stage and the names of the estimates."""

import dataclasses

ESTIMATES = ("consensus", "closest", "median", "farthest")
MAX_CAMERAS = 64

# Half the footprint of one source pixel on the target, px; larger patches are cut to it. It bounds
# the work per point when the target magnifies much.
MAX_REACH_PX = 16.0
# Neighbours whose disparities differ by more are not one surface, px. A surface that both cameras of
# a pair see from the front changes by less than one per pixel (the ordering constraint).
MAX_STEP_PX = 1.0
# A point whose inverse depth is negative by less is noise around infinity, in sigmas.
INFINITY_SIGMAS = 2.0
# Least ratio of relative noise in the target to relative noise in the source: keeps sigma above 0
# where the source ray is perpendicular to the target's axis.
SIGMA_FLOOR = 0.25
# Added to the squared sine of the angle between rays, so that equal rays have a finite weight.
MIN_SINE_SQUARED = 1e-5


@dataclasses.dataclass(frozen=True)
class FuseOptions:
    """Settings of fusion.

    tolerance: largest difference of two inverse depths that agree, in their combined sigma
    min_pairs: pairs that have to agree for a consensus; capped at the number of usable pairs
    min_cameras: distinct cameras that these pairs have to include
    footprint: half the side of the square patch that one source pixel covers, source px
    num_sources: original images blended per pixel
    memory_mb: bound for the cost volume of a tile and the disparities kept, each
    """

    tolerance: float = 2.0
    min_pairs: int = 3
    min_cameras: int = 2
    footprint: float = 0.6
    num_sources: int = 2
    memory_mb: int = 512
