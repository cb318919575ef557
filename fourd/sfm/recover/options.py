"""Settings of `recover`; their meaning, units and ranges stand in config/schemas/recover.schema.yaml."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class RecoverOptions:
    """Options of the recovery of cameras from films."""

    num_keyframes: int = 4
    features: str = "sift"
    learned_weights: str = ""
    max_features: int = 4000
    match_ratio: float = 0.8
    max_match_error_px: float = 3.0
    min_matches: int = 20
    patch_radius_px: int = 7
    min_patch_score: float = 0.85
    max_error_px: float = 1.0
    loss_scale_px: float = 0.3
    max_landmarks: int = 300
    max_adjusted_frames: int = 400
    margin_s: float = 2.0
    shared_lens: bool = False
