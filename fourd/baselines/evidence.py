"""What a method is given to make one frame of a held-out view."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from fourd.baselines.nearest import FilmIndex
from fourd.baselines.warp import Warp, warp_inputs
from fourd.camera import Camera


class Unavailable(Exception):
    """A method cannot run on this event; the message is the reason that the table gives."""


@dataclasses.dataclass(frozen=True, eq=False)
class InputPicture:
    """What one input camera filmed at the rendered moment, as an ideal pinhole of the output size.

    image: (H, W, 3) uint8;  valid: (H, W) bool where the camera looked
    feature: (N,) of unit length, what the nearest neighbours compare
    """

    image: np.ndarray
    valid: np.ndarray
    camera: Camera
    feature: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """All images are (H, W, 3) uint8 RGB of the output size, masks (H, W) bool.

    foreground: `consensus_rgb`, `consensus_valid`, `depth`, `num_cameras`
    background: `farthest_rgb`, `farthest_valid`, `depth`, `filled`;  depths in world units, NaN = blank
    rendered:   the frame that the stage `render` wrote
    inputs:     what each input camera filmed at the same time
    truth:      what the held-out camera filmed; only the nearest neighbours may ask it which
                picture is nearest, no method may copy from it
    camera:     the pinhole to render for
    points:     (N, 3) float64 sparse points, world units
    films:      features of all input cameras over the whole event
    query:      feature of the truth
    others:     frames that other programs rendered, by the name of the method
    people:     (N, P) fits of the body to the people of the moment, None where nobody was looked for
    no_people:  why not;  humans: folder with the body
    """

    foreground: Mapping[str, np.ndarray]
    background: Mapping[str, np.ndarray]
    rendered: np.ndarray
    inputs: Mapping[str, InputPicture]
    truth: np.ndarray
    camera: Camera
    points: np.ndarray
    films: FilmIndex
    query: np.ndarray
    others: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    people: np.ndarray | None = None
    no_people: str = ""
    humans: str = ""

    @functools.cached_property
    def depth(self) -> np.ndarray:
        """(H, W) float32 z of the surface in view: of the consensus, else of the background, else NaN."""
        return surface_depth(self.foreground, self.background)

    @functools.cached_property
    def warp(self) -> Warp:
        """The inputs seen over the surface in view."""
        return warp_inputs(
            self.depth,
            self.camera,
            [(entry.image, entry.valid, entry.camera) for entry in self.inputs.values()],
        )


def surface_depth(foreground: Mapping[str, np.ndarray], background: Mapping[str, np.ndarray]) -> np.ndarray:
    """(H, W) float32 z of the consensus, else of the background, else NaN; arrays as in `Evidence`."""
    static = np.where(background["farthest_valid"], background["depth"], np.float32(np.nan))
    return np.where(foreground["consensus_valid"], foreground["depth"], static)
