"""Stage `evaluate`: what was rendered for held-out cameras against what they filmed.

`camera` scores one held-out camera, `collect` joins all of them into one table and one contact
sheet. Nothing that makes a render reads what this stage writes, or a held-out camera's pictures.
"""

import dataclasses

STAGE_VERSION = 4


@dataclasses.dataclass(frozen=True)
class EvaluateOptions:
    """The meaning of each key is in config/schemas/evaluate.schema.yaml."""

    dynamic_threshold: float = 15.0
    dynamic_tolerance_px: int = 2
    dynamic_min_share: float = 0.0002
    neighbour_frames: int = 30
    lpips_weights: str = ""
    lpips_net: str = "alex"
    inception: str = ""
    humans: str = ""
    depths: str = ""
    other: tuple[str, ...] = ()
    sheet_frames: int = 3
    sheet_tile_px: int = 288
    sheet_error_gain: float = 4.0
