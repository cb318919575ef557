"""Settings of the stage; their meaning, units and ranges stand in config/schemas/frames.schema.yaml."""

import dataclasses

from fourd.flow import CompensationOptions


@dataclasses.dataclass(frozen=True)
class FramesOptions:
    """Options of time compensation and of common colours."""

    compensate: bool = True
    min_dt_s: float = 0.002
    min_motion_px: float = 0.7
    max_flow_width_px: int = 960
    match_colours: bool = True
    num_colour_frames: int = 4
    min_colour_matches: int = 60
    min_colour_change: float = 4.0

    @property
    def compensation(self) -> CompensationOptions:
        """What `fourd.flow.compensate_motion` takes."""
        names = [field.name for field in dataclasses.fields(CompensationOptions)]
        return CompensationOptions(**{name: getattr(self, name) for name in names})
