"""Pinhole cameras with lens distortion, one per camera and frame.

Convention: OpenCV axes (x right, y down, z forward), `x_cam = R @ x_world + t`, the centre of the
top-left pixel is (0, 0), sizes are (width, height). All poses are float64.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from fourd.errors import InputError, explain_faults
from fourd.io import MAX_IMAGE_SIDE_PX

NUM_DISTORTION = 5
# Corners of real calibrations fold back by up to half a percent of the picture.
MAX_FOLDED_SHARE = 0.05
# Beyond, double precision has no decimals left, and squares soon overflow.
MAX_NUMBER = 1e15


def _zero_distortion() -> np.ndarray:
    return np.zeros(NUM_DISTORTION)


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """One view at one instant.

    K: (3, 3) intrinsics, px;  R: (3, 3), t: (3,) cam_from_world, world units
    size: (width, height), px;  distortion: (5,) OpenCV order k1 k2 p1 p2 k3
    """

    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    size: tuple[int, int]
    distortion: np.ndarray = dataclasses.field(default_factory=_zero_distortion)

    @property
    def center(self) -> np.ndarray:
        """(3,) centre of projection, world units."""
        return -self.R.T @ self.t

    @property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths, px."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @property
    def forward(self) -> np.ndarray:
        """(3,) unit vector along the optical axis, world frame."""
        return self.R[2]

    @property
    def is_distorted(self) -> bool:
        return bool(np.any(self.distortion != 0))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel positions and depths of world points.

        points: (..., 3) world units
        Returns (..., 2) px and (...,) depth z; pixels are NaN where z <= 0.
        """
        in_cam = points @ self.R.T + self.t
        depth = in_cam[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            normalized = in_cam[..., :2] / depth[..., None]
        pixels = self.pixels_from_normalized(normalized)
        return np.where(depth[..., None] > 0, pixels, np.nan), depth

    def pixels_from_normalized(self, normalized: np.ndarray) -> np.ndarray:
        """Lens and intrinsics: (..., 2) image-plane coordinates at z = 1 to (..., 2) px.

        Source: OpenCV calib3d, "Detailed Description" (Brown-Conrady, five coefficients).
        """
        x, y = normalized[..., 0], normalized[..., 1]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        u = self.K[0, 0] * xd + self.K[0, 1] * yd + self.K[0, 2]
        return np.stack([u, self.K[1, 1] * yd + self.K[1, 2]], axis=-1)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """(..., 3) directions in the camera frame with z = 1, through (..., 2) px."""
        if self.is_distorted:
            flat = np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
            normalized = cv2.undistortPoints(flat, self.K, self.distortion, criteria=criteria)
            normalized = normalized.reshape(pixels.shape)
        else:
            y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
            x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
            normalized = np.stack([x, y], axis=-1)
        return np.concatenate([normalized, np.ones_like(normalized[..., :1])], axis=-1)

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """(..., 3) world points at depth z (...,) along the rays of (..., 2) px."""
        return (self.rays(pixels) * depth[..., None] - self.t) @ self.R

    def resized(self, size: tuple[int, int]) -> "Camera":
        """The same view sampled at another size. Pixel areas scale, so centres shift by half."""
        scale = np.array([size[0] / self.size[0], size[1] / self.size[1]])
        K = self.K.copy()
        K[:2] *= scale[:, None]
        K[:2, 2] += (scale - 1) / 2
        return dataclasses.replace(self, K=K, size=size)

    def without_distortion(self) -> "Camera":
        """The ideal pinhole with the same intrinsics: what the workflow renders."""
        return dataclasses.replace(self, distortion=_zero_distortion())

    def to_dict(self) -> dict[str, Any]:
        """JSON form of the pose and lens (the size is kept once per track)."""
        document = {"K": self.K.tolist(), "R": self.R.tolist(), "t": self.t.tolist()}
        if self.is_distorted:
            document["distortion"] = self.distortion.tolist()
        return document


def camera_from_dict(document: Mapping[str, Any], size: tuple[int, int], where: str) -> Camera:
    """Camera from its JSON form, checked.

    where: file and camera name for the error message
    Raises InputError for missing entries, wrong shapes, NaN, singular K or a matrix that is no
    rotation.
    """
    try:
        K = np.asarray(document["K"], dtype=np.float64).reshape(3, 3)
        R = np.asarray(document["R"], dtype=np.float64).reshape(3, 3)
        t = np.asarray(document["t"], dtype=np.float64).reshape(3)
        lens = np.zeros(NUM_DISTORTION)
        given = np.asarray(document.get("distortion") or [], dtype=np.float64).ravel()
        lens[: given.size] = given
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: expected K 3x3, R 3x3, t 3 and distortion up to 5, {error!r}") from None
    camera = Camera(K, R, t, (int(size[0]), int(size[1])), lens)
    check_camera(camera, where)
    return camera


def check_camera(camera: Camera, where: str) -> None:
    """Raise InputError, naming `where`, unless the camera can be used for geometry."""
    # NaN is not less than anything.
    if not all((np.abs(a) < MAX_NUMBER).all() for a in (camera.K, camera.R, camera.t, camera.distortion)):
        raise InputError(
            f"{where}: K, R, t must be finite numbers below {MAX_NUMBER:.0e}, got NaN, infinity or larger "
            "ones: fix the calibration"
        )
    is_upper = abs(camera.K[1, 0]) <= 1e-6 * camera.K[1, 1] and np.allclose(camera.K[2], [0, 0, 1])
    if camera.K[0, 0] <= 0 or camera.K[1, 1] <= 0 or not is_upper:
        raise InputError(
            f"{where}: K must have positive focal lengths, zeros below them and last row 0 0 1, got "
            f"{camera.K.tolist()}: fix the calibration"
        )
    folded = folded_share(camera)
    if folded > MAX_FOLDED_SHARE:
        raise InputError(
            f"{where}: the lens must give every pixel a ray, got distortion {camera.distortion.tolist()}, "
            f"which folds back inside the picture ({100 * folded:.0f} % of it have no ray): calibrate with "
            "fewer coefficients, or crop the frames"
        )
    error = float(np.abs(camera.R @ camera.R.T - np.eye(3)).max())
    if error > 1e-4 or np.linalg.det(camera.R) < 0:
        raise InputError(
            f"{where}: R must be a rotation (R R^T = 1 within 1e-4, determinant +1), got error {error:.2g} "
            f"and determinant {np.linalg.det(camera.R):.3g}: fix the calibration"
        )


def folded_share(camera: Camera) -> float:
    """Share of the picture, mostly its corners, that no ray reaches: the lens polynomial turns back before.

    What `rays` gives for such a pixel comes back more than a pixel beside it.
    """
    if not camera.is_distorted:
        return 0.0
    return _folded_share(camera.size, tuple(camera.K.ravel()), tuple(camera.distortion))


@functools.lru_cache(maxsize=256)
def _folded_share(size: tuple[int, int], K: tuple[float, ...], distortion: tuple[float, ...]) -> float:
    """Kept, because a camera that moves has one lens and thousands of poses."""
    camera = Camera(np.reshape(K, (3, 3)), np.eye(3), np.zeros(3), size, np.array(distortion))
    pixels = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 33) for n in camera.size)), axis=-1)
    miss_px = np.abs(camera.pixels_from_normalized(camera.rays(pixels)[..., :2]) - pixels).max(axis=-1)
    return float((~(miss_px < 1)).mean())


@dataclasses.dataclass(frozen=True, eq=False)
class CameraTrack:
    """A physical camera over time: one `Camera` per frame, or a single one when it stands still.

    near, far: range of depth of what it films, world units (far may be infinite)
    """

    name: str
    cameras: tuple[Camera, ...]
    near: float = 0.0
    far: float = float("inf")

    @property
    def is_static(self) -> bool:
        return len(self.cameras) == 1

    @property
    def size(self) -> tuple[int, int]:
        return self.cameras[0].size

    def at(self, frame: int) -> Camera:
        """The camera at a frame of the common clock. Raises InputError past the track's end."""
        if self.is_static:
            return self.cameras[0]
        if not 0 <= frame < len(self.cameras):
            raise InputError(
                f"camera {self.name}: expected a frame in 0..{len(self.cameras) - 1}, got {frame}: "
                "shorten num_frames in the scene file or calibrate more frames"
            )
        return self.cameras[frame]


def tracks_to_dict(tracks: Mapping[str, CameraTrack]) -> dict[str, Any]:
    """JSON form of all cameras (docs/formats.md, cameras.json)."""
    return {
        name: {
            "size": list(track.size),
            "near": track.near,
            "far": track.far if np.isfinite(track.far) else None,
            "frames": [camera.to_dict() for camera in track.cameras],
        }
        for name, track in tracks.items()
    }


def tracks_from_dict(document: Mapping[str, Any], where: str) -> dict[str, CameraTrack]:
    """Inverse of `tracks_to_dict`; every camera is checked. Raises InputError."""
    with explain_faults(f"cameras by name in {where}"):
        return {name: _track_from_dict(name, entry, where) for name, entry in document.items()}


def _track_from_dict(name: str, entry: Mapping[str, Any], where: str) -> CameraTrack:
    size = (int(entry["size"][0]), int(entry["size"][1]))
    near = float(entry.get("near") or 0.0)
    far = float("inf") if entry.get("far") is None else float(entry["far"])
    if not 1 <= min(size) <= max(size) <= MAX_IMAGE_SIDE_PX or not entry["frames"] or not 0 <= near < far:
        raise ValueError(f"{name}: size {size}, {len(entry['frames'])} frames, near {near}, far {far}")
    cameras = tuple(
        camera_from_dict(frame, size, f"{where}, camera {name}, frame {i}")
        for i, frame in enumerate(entry["frames"])
    )
    return CameraTrack(name, cameras, near, far)
