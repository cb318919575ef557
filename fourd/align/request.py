"""What is asked of the clocks: which cameras, which of them are held out, which part of the event."""

import dataclasses

from fourd.errors import InputError


@dataclasses.dataclass(frozen=True)
class ClockRequest:
    """names: all cameras, in the scene's order;  fps, num_frames: of the common clock's frames

    start_s: common time of frame 0, None for the earliest that all input cameras film
    """

    names: tuple[str, ...] = ()
    heldout: tuple[str, ...] = ()
    fps: float = 30.0
    num_frames: int = 1
    start_s: float | None = None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Cameras that the common clock is made from."""
        return tuple(name for name in self.names if name not in self.heldout)


def check_request(request: ClockRequest) -> None:
    """Raise InputError for names or numbers that make no sense."""
    if not request.fps > 0 or request.num_frames < 1:
        raise InputError(
            f"expected fps above 0 and 1 frame or more, got {request.fps} and {request.num_frames}: correct "
            "the scene file"
        )
    unknown = [name for name in request.heldout if name not in request.names]
    if unknown or len(request.inputs) < 2:
        raise InputError(
            f"expected held-out cameras of {', '.join(request.names)} and 2 others, got "
            f"{', '.join(request.heldout) or 'none'}: correct `heldout` in the scene file"
        )
