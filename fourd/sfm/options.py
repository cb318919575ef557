"""Settings of the stage; their meaning, units and ranges stand in config/schemas/sfm.schema.yaml."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SfmOptions:
    """Options of sparse matching and of the depth bounds that come from it."""

    num_sparse_frames: int = 2
    max_features: int = 4000
    num_neighbors: int = 3
    max_pair_angle_deg: float = 35.0
    match_ratio: float = 0.8
    max_epipolar_error_px: float = 1.5
    max_reprojection_error_px: float = 1.5
    min_triangulation_angle_deg: float = 0.5
    min_points: int = 30
    near_percentile: float = 0.5
    near_margin: float = 0.7
    fallback_near_fraction: float = 0.1
    use_far_bound: bool = True
