"""How clocks are refined together with the trajectories of moving points."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SpatiotemporalOptions:
    """See config/schemas/align_spatiotemporal.schema.yaml."""

    prior: str = "force"
    start: str = "incremental"
    knot_spacing_frames: float = 1.0
    search_frames: float = 3.0
    estimate_rate: bool = False
    estimate_readout: bool = False
    max_sigma_frames: float = 0.25
    min_inliers: float = 0.5
    pair_points: int = 12
    group_points: int = 40
