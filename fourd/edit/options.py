"""Settings of the stage."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class EditOptions:
    """Settings of the stage (config/schemas/edit.schema.yaml).

    num_times: frames of the clip that tell what moves
    grow_px: how far an edit reaches beyond the outline;  feather_px: standard deviation of its soft edge
    network: TorchScript file that carries masks instead of optical flow, None for flow
    """

    num_times: int = 6
    grow_px: float = 1.5
    feather_px: float = 1.0
    network: str | None = None
