"""What can be chosen about the demo event."""

import dataclasses

from fourd.errors import InputError


@dataclasses.dataclass(frozen=True)
class DemoOptions:
    """Options of the demo event; units and ranges in config/schemas/demo.schema.yaml."""

    num_cameras: int = 9
    num_frames: int = 30
    fps: float = 30.0
    width: int = 480
    height: int = 270
    samples_per_axis: int = 2
    seed: int = 7
    arc_deg: float = 88.0
    distance_m: float = 4.5
    eye_height_m: float = 1.6
    shake_m: float = 0.02
    shake_deg: float = 0.8
    num_orbit_views: int = 12


def camera_names(options: DemoOptions) -> list[str]:
    """cam00, cam01, ... along the arc from left to right as the cameras see it."""
    return [f"cam{index:02d}" for index in range(options.num_cameras)]


def camera_index(name: str, options: DemoOptions) -> int:
    """Position of a camera on the arc. Raises InputError if there is no such camera."""
    names = camera_names(options)
    if name not in names:
        raise InputError(f"expected a camera of the demo ({names[0]}..{names[-1]}), got {name!r}: choose one")
    return names.index(name)


def check_options(options: DemoOptions) -> None:
    """Raise InputError for values that no event can be made from."""
    limits = {
        "num_cameras": (2, 64),
        "num_frames": (1, 100_000),
        "fps": (1, 1000),
        "width": (16, 8192),
        "height": (16, 8192),
        "samples_per_axis": (1, 8),
        "seed": (0, 2**31 - 1),
        "arc_deg": (0, 360),
        "distance_m": (3, 5.2),
        "eye_height_m": (0.5, 3),
        "shake_m": (0, 0.2),
        "shake_deg": (0, 10),
        "num_orbit_views": (1, 1000),
    }
    for name, (low, high) in limits.items():
        value = getattr(options, name)
        if not low <= value <= high:
            raise InputError(
                f"demo option {name}: expected a value in {low}..{high}, got {value}: change it in the config"
            )
