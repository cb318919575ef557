"""Settings of the stage and the names of the estimates."""

import dataclasses

import numpy as np

ESTIMATES = ("consensus", "closest", "median", "farthest")
MAX_CAMERAS = 64
# What gave the depth of a pixel.
NO_DEPTH, STEREO, HULL = 0, 1, 2

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
# Least share of a blended source whose cost reaches that of the best left out.
MIN_WEIGHT = 1e-3
# Keys' parameter of bicubic sampling; -0.5 is exact for quadratics (Catmull-Rom).
KEYS_A = -0.5


@dataclasses.dataclass(frozen=True)
class FuseOptions:
    """Settings of fusion.

    tolerance: largest difference of two inverse depths that agree, in their combined sigma
    min_pairs: pairs that have to agree for a consensus; capped at the number of usable pairs
    min_cameras: distinct cameras that these pairs have to include
    max_front: samples that may lie in front of a consensus, per pair that supports it; blank above.
        With pairs that see something nearer, but too few to agree, the surface behind is hidden
        more often than not
    footprint: half the side of the square patch that one source pixel covers, source px
    num_sources: original images blended per pixel
    visibility: whether the consensus takes a sample of fewer pairs where two cameras or more confirm it and
        none sees through it
    memory_mb: bound for the cost volume of a tile and the disparities kept, each
    """

    tolerance: float = 3.0
    min_pairs: int = 3
    min_cameras: int = 2
    max_front: float = 1.0
    footprint: float = 0.6
    num_sources: int = 4
    visibility: bool = True
    memory_mb: int = 512


@dataclasses.dataclass(frozen=True)
class FusionRules:
    """What the reduction of one view needs, after capping to what the scene can give.

    farthest_min_pairs: pairs that have to agree with the farthest; 1 is the plain farthest
    estimates: to be reduced;  visibility: whether cameras are asked about the consensus afterwards
    """

    tolerance: float
    min_pairs: int
    min_cameras: int
    max_front: float
    farthest_min_pairs: int
    estimates: tuple[str, ...]
    visibility: bool = False

    def numbers(self) -> np.ndarray:
        """(3,) int64 as the kernels read them."""
        return np.array([self.min_pairs, self.min_cameras, self.farthest_min_pairs], np.int64)

    def wanted(self) -> np.ndarray:
        """(4,) bool in the order of ESTIMATES."""
        return np.array([name in self.estimates for name in ESTIMATES])
