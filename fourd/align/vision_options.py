"""Settings of visual alignment (config/schemas/align_vision.schema.yaml)."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class VisionOptions:
    """use: `auto` (where sound leaves doubt), `always` or `never`

    max_delay_s: largest difference between the starts of two films that is searched without sound, s
    max_sound_sigma_frames: sound that is less certain than this is checked by sight, frames
    work_px: longer side of the pictures that points are tracked in, px
    min_track_frames: shorter tracks of points are dropped
    max_descriptors: of moving points per film
    valley_deg: angle off the epipolar plane at which a pair of tracks stops speaking for an offset
    min_visual_score: least score of a delay that is believed
    """

    use: str = "auto"
    max_delay_s: float = 10.0
    max_sound_sigma_frames: float = 0.1
    work_px: int = 960
    min_track_frames: int = 8
    max_descriptors: int = 4000
    valley_deg: float = 0.3
    min_visual_score: float = 0.5
