"""Cameras, points and observations of a scene while they are being recovered, and COLMAP's form of them.

Pixels are ours here, the centre of the top-left one (0, 0); COLMAP's is (0.5, 0.5). The half is added
and taken away in this module alone.
"""

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np
import pycolmap

from fourd.camera import NUM_DISTORTION, Camera

HALF_PIXEL = 0.5
LENS_MODELS = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")

# One picture: the camera's name and the frame of its film.
ImageKey = tuple[str, int]


@dataclasses.dataclass(frozen=True)
class Lens:
    """Intrinsics that all frames of one phone share.

    size: (width, height) px;  focal_px: px;  radial: (), (k1,) or (k1, k2)
    principal_px: the principal point from the picture's middle, px; None holds it there
    """

    size: tuple[int, int]
    focal_px: float
    radial: tuple[float, ...] = ()
    principal_px: tuple[float, float] | None = None

    def at(self, R: np.ndarray, t: np.ndarray) -> Camera:
        """The camera with this lens at a pose cam_from_world."""
        width, height = self.size
        x, y = self.principal_px or (0.0, 0.0)
        K = np.array(
            [[self.focal_px, 0, (width - 1) / 2 + x], [0, self.focal_px, (height - 1) / 2 + y], [0, 0, 1.0]]
        )
        distortion = np.zeros(NUM_DISTORTION)
        distortion[: len(self.radial)] = self.radial
        return Camera(K, R, t, self.size, distortion)

    def to_colmap(self, camera_id: int) -> pycolmap.Camera:
        """COLMAP's camera of the smallest model that holds this lens."""
        width, height = self.size
        x, y = self.principal_px or (0.0, 0.0)
        return pycolmap.Camera(
            camera_id=camera_id,
            model=LENS_MODELS[len(self.radial)],
            width=width,
            height=height,
            params=[self.focal_px, width / 2 + x, height / 2 + y, *self.radial],
        )

    def updated(self, camera: pycolmap.Camera) -> "Lens":
        """The lens with the numbers of its camera of COLMAP, the same ones free."""
        focal_px, cx, cy, *radial = (float(p) for p in camera.params)
        principal = None if self.principal_px is None else (cx - self.size[0] / 2, cy - self.size[1] / 2)
        return Lens(self.size, focal_px, tuple(radial), principal)


@dataclasses.dataclass(frozen=True, eq=False)
class Model:
    """A recovered scene.

    lenses: by camera name, all equal if is_lens_shared
    poses: (3, 4) float64 [R | t] cam_from_world by picture
    points: (P, 3) float64
    Observations, one a row: obs_image (M,) index into `images`, obs_point (M,) index into points,
    obs_px (M, 2) px
    """

    lenses: Mapping[str, Lens]
    poses: Mapping[ImageKey, np.ndarray]
    points: np.ndarray
    obs_image: np.ndarray
    obs_point: np.ndarray
    obs_px: np.ndarray
    is_lens_shared: bool = False

    @property
    def images(self) -> list[ImageKey]:
        """Pictures with a pose, in the order that `obs_image` counts."""
        return list(self.poses)

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras with a pose, in the order of the lenses."""
        used = {name for name, _ in self.poses}
        return [name for name in self.lenses if name in used]

    def camera(self, image: ImageKey) -> Camera:
        """The camera of one picture."""
        pose = self.poses[image]
        return self.lenses[image[0]].at(pose[:, :3], pose[:, 3])

    def residuals_px(self) -> np.ndarray:
        """(M, 2) projection minus observation, px; NaN where the point is behind the camera."""
        residual = np.full_like(self.obs_px, np.nan)
        order = np.argsort(self.obs_image, kind="stable")
        edges = np.searchsorted(self.obs_image[order], np.arange(len(self.poses) + 1))
        for i, image in enumerate(self.images):
            rows = order[edges[i] : edges[i + 1]]
            projected, _ = self.camera(image).project(self.points[self.obs_point[rows]])
            residual[rows] = projected - self.obs_px[rows]
        return residual

    def select(self, keep: np.ndarray) -> "Model":
        """The same with the observations that `keep` (M,) bool marks; points keep their numbers."""
        return dataclasses.replace(
            self,
            obs_image=self.obs_image[keep],
            obs_point=self.obs_point[keep],
            obs_px=self.obs_px[keep],
        )

    def supported(self) -> "Model":
        """The same without observations of points that fewer than two cameras see.

        One film alone hardly moves: its points have no depth, and may well be people.
        """
        names = self.cameras
        number = np.array([names.index(name) for name, _ in self.poses], dtype=np.int64)
        seen = np.zeros((len(self.points), len(names)), dtype=bool)
        seen[self.obs_point, number[self.obs_image]] = True
        return self.select((seen.sum(axis=1) >= 2)[self.obs_point])

    def joined(self, other: "Model") -> "Model":
        """Both models' pictures of other cameras over this one's points, which both observe."""
        lenses = dict(other.lenses)
        if self.is_lens_shared:
            lenses = dict.fromkeys(lenses, next(iter(self.lenses.values())))
        return dataclasses.replace(
            self,
            lenses={**self.lenses, **lenses},
            poses={**self.poses, **other.poses},
            obs_image=np.concatenate([self.obs_image, other.obs_image + len(self.poses)]),
            obs_point=np.concatenate([self.obs_point, other.obs_point]),
            obs_px=np.concatenate([self.obs_px, other.obs_px]),
        )

    def compact(self) -> "Model":
        """The same without points that no picture sees; the others are numbered anew."""
        keep = np.bincount(self.obs_point, minlength=len(self.points)) > 0
        number = np.cumsum(keep) - 1
        return dataclasses.replace(self, points=self.points[keep], obs_point=number[self.obs_point])


def lens_ids(names: Iterable[str], is_shared: bool) -> dict[str, int]:
    """COLMAP's camera ids: they count the lenses from 1, or all are 1."""
    return {name: 1 if is_shared else i + 1 for i, name in enumerate(names)}


def to_reconstruction(model: Model, has_witness: bool = False) -> pycolmap.Reconstruction:
    """COLMAP's form; camera ids as `lens_ids` counts, image ids count the pictures from 1.

    has_witness: a further picture, the last, also observes every point; COLMAP refuses to adjust a
    picture to points that it alone sees, even where the points are given
    """
    reconstruction = pycolmap.Reconstruction()
    camera_ids = lens_ids(model.lenses, model.is_lens_shared)
    for name, camera_id in camera_ids.items():
        if not reconstruction.exists_camera(camera_id):
            reconstruction.add_camera_with_trivial_rig(model.lenses[name].to_colmap(camera_id))
    order = np.argsort(model.obs_image, kind="stable")
    edges = np.searchsorted(model.obs_image[order], np.arange(len(model.poses) + 1))
    index_in_image = np.empty(len(order), dtype=np.int64)
    for i, (key, pose) in enumerate(model.poses.items()):
        rows = order[edges[i] : edges[i + 1]]
        index_in_image[rows] = np.arange(len(rows))
        image = pycolmap.Image(
            name=f"{key[0]}/{key[1]:06d}",
            keypoints=model.obs_px[rows] + HALF_PIXEL,
            camera_id=camera_ids[key[0]],
            image_id=i + 1,
        )
        rigid = pycolmap.Rigid3d(np.ascontiguousarray(pose))
        reconstruction.add_image_with_trivial_frame(image, rigid)
    witness = len(model.poses) + 1
    if has_witness:
        nowhere = np.zeros((len(model.points), 2))
        image = pycolmap.Image(name="witness", keypoints=nowhere, camera_id=1, image_id=witness)
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    order = np.argsort(model.obs_point, kind="stable")
    edges = np.searchsorted(model.obs_point[order], np.arange(len(model.points) + 1))
    white = np.full(3, 255, np.uint8)
    for p, point in enumerate(model.points):
        rows = order[edges[p] : edges[p + 1]]
        seen = [pycolmap.TrackElement(int(model.obs_image[r]) + 1, int(index_in_image[r])) for r in rows]
        seen += [pycolmap.TrackElement(witness, p)] * has_witness
        reconstruction.add_point3D(point, pycolmap.Track(seen), white)
    return reconstruction


def update_from_reconstruction(model: Model, reconstruction: pycolmap.Reconstruction) -> Model:
    """The model with lenses, poses and points taken from its adjusted reconstruction."""
    ids = lens_ids(model.lenses, model.is_lens_shared)
    lenses = {name: lens.updated(reconstruction.cameras[ids[name]]) for name, lens in model.lenses.items()}
    poses = {
        key: np.asarray(reconstruction.images[i + 1].cam_from_world().matrix())
        for i, key in enumerate(model.poses)
    }
    points = np.stack([reconstruction.points3D[p + 1].xyz for p in range(len(model.points))])
    return dataclasses.replace(model, lenses=lenses, poses=poses, points=points)
