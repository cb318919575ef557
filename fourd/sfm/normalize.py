"""The similarity that puts the scene's cameras around the origin at distance about one.

Positions are float64 in and out. A camera position keeps about 16 digits, so a source world whose
origin lies D scene sizes away gives normalised positions that are exact to about 1e-16 D: 1e7 is
harmless, from 1e10 on it is refused. Nothing else depends on the source's units.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import convergence_point, nearest_rotation

# Centres are kept to this part of the world unit, far below what any calibration knows: what comes after
# must not depend on the last bits of the source's digits, and matching takes every bit for a picture.
CENTER_STEP = 2.0**-20

# Axes whose directions spread less than this meet too far away to name a point.
MIN_CONVERGENCE_DEG = 2.0

# Largest rounding of a source position, in world units, that still leaves the scene recognisable.
MAX_ROUNDING = 1e-6

# Weight of the mean image-up axis against level right-hand axes: a tie-break, not an opinion.
MEAN_UP_WEIGHT = 1e-2

# Centres closer together than this many roundings of their distance from the source's origin coincide.
COINCIDENT_ROUNDINGS = 64


@dataclasses.dataclass(frozen=True, eq=False)
class Similarity:
    """World to source: source = world * scale + origin.

    origin: (3,) source units;  scale: source units per world unit
    converges: the origin is the point where the optical axes meet, and the world unit is the
    cameras' typical distance to it; otherwise it is their mean centre and their typical spread
    """

    origin: np.ndarray
    scale: float
    converges: bool

    def world_from_source(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) source points in world units."""
        return (points - self.origin) / self.scale

    def apply(self, camera: Camera) -> Camera:
        """The same camera in the normalised world, its R made exactly orthonormal."""
        # solve, not R.T: the centre is the null vector of [R | t] even when R is rounded.
        center = self.world_from_source(np.linalg.solve(camera.R, -camera.t))
        R = nearest_rotation(camera.R)
        return dataclasses.replace(camera, R=R, t=-R @ center)


def snap_center(camera: Camera) -> Camera:
    """The camera with its centre on the grid of `CENTER_STEP`, moved by at most half a step per axis."""
    center = np.round(camera.center / CENTER_STEP) * CENTER_STEP
    return dataclasses.replace(camera, t=-camera.R @ center)


def estimate_similarity(cameras: Sequence[Camera]) -> Similarity:
    """Similarity from the input cameras, each physical camera equally often in the list.

    The origin is the convergence point of the optical axes when they are not near-parallel and it
    lies in front of every camera, and the scale the median distance to it; otherwise the origin is
    the mean centre and the scale the RMS distance from it, or 1 if all centres coincide.
    Raises InputError if the positions' digits do not tell the cameras apart well enough.
    """
    centers = np.stack([np.linalg.solve(c.R, -c.t) for c in cameras])
    middle = centers.mean(axis=0)
    point = convergence_point(cameras)
    depths = np.array([c.forward @ (point - center) for c, center in zip(cameras, centers, strict=True)])
    distances = np.linalg.norm(centers - point, axis=1)
    floor = COINCIDENT_ROUNDINGS * np.finfo(np.float64).eps * float(np.abs(centers).max())
    scale = float(np.median(distances))
    # In front by a tenth: a point beside a camera is no place that it films.
    is_in_front = bool((depths > 0.1 * scale).all())
    if is_in_front and scale > floor and _axes_spread_deg(cameras) > MIN_CONVERGENCE_DEG:
        similarity = Similarity(point, scale, True)
    else:
        spread = float(np.sqrt(((centers - middle) ** 2).sum(axis=1).mean()))
        similarity = Similarity(middle, spread if spread > floor else 1.0, False)
    rounding = float(np.finfo(np.float64).eps * np.abs(centers).max() / similarity.scale)
    if rounding > MAX_ROUNDING:
        raise InputError(
            f"the calibration's origin lies so far away that positions are rounded to {rounding:.1g} of the "
            f"scene's size, more than {MAX_ROUNDING:g}: expected cameras near the origin of their world; "
            "subtract a common offset from their positions"
        )
    return similarity


def _axes_spread_deg(cameras: Sequence[Camera]) -> float:
    """Angle that the optical axes spread, degrees: the RMS angle from their principal line."""
    axes = np.stack([c.forward for c in cameras])
    # The two smaller singular values are the RMS sines off the principal direction.
    off_principal = np.linalg.svd(axes, compute_uv=False)[1:]
    return float(np.degrees(np.sqrt((off_principal**2).sum() / len(axes))))


def sample_cameras(tracks: Mapping[str, Sequence[Camera]], num_samples: int = 9) -> list[Camera]:
    """Cameras at evenly spaced frames, every physical camera equally often."""
    length = max(len(cameras) for cameras in tracks.values())
    frames = np.unique(np.linspace(0, length - 1, num_samples).round().astype(int))
    return [cameras[0] if len(cameras) == 1 else cameras[f] for cameras in tracks.values() for f in frames]


def estimate_up(cameras: Sequence[Camera]) -> np.ndarray:
    """(3,) unit vector that is upward in the world, as far as the cameras tell.

    People hold phones level, so the image's right-hand axes lie in the horizontal plane whether or
    not the phones look down: up is the direction most perpendicular to them. The mean image-up axis
    gives the sign, and the direction where the right-hand axes are all parallel. If the image-up
    axes cancel (cameras upside down facing as many upright ones) the first camera's is taken.
    """
    mean_up = -np.stack([c.R[1] for c in cameras]).mean(axis=0)
    length = np.linalg.norm(mean_up)
    mean_up = mean_up / length if length > 1e-3 else -cameras[0].R[1]
    right = np.stack([c.R[0] for c in cameras])
    spread = right.T @ right / len(cameras) + MEAN_UP_WEIGHT * (np.eye(3) - np.outer(mean_up, mean_up))
    up = np.linalg.eigh(spread)[1][:, 0]
    return up * np.sign(up @ mean_up)
