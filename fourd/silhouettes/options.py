"""Settings of the stage."""

import dataclasses

MOVING = 255
BACKGROUND = 0
UNKNOWN = 128
USES = ("auto", "always", "never")


@dataclasses.dataclass(frozen=True)
class SilhouetteOptions:
    """Settings of silhouettes.

    use: auto makes silhouettes where stereo leaves cameras alone; always; never
    min_pairs: matched pairs that every camera takes part in where stereo suffices
    num_samples: pictures that the plate of a camera is made from
    threshold: least difference to the plate that is no noise, in standard deviations
    jitter_px: how far pictures of a camera on a tripod shift, px; edges differ by that much more
    shadow_strength: least share of the plate's brightness that a shadow leaves
    min_area_share: smallest patch that moves, or gap in one, as a share of the picture
    """

    use: str = "auto"
    min_pairs: int = 2
    num_samples: int = 31
    threshold: float = 4.0
    jitter_px: float = 0.5
    shadow_strength: float = 0.6
    min_area_share: float = 0.0005
