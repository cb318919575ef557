"""Training samples: what the other cameras saw of a camera's view, and its own frame as the target.

A sample is a stack of seven RGBA images of one camera and frame at one level's size, uint8: the
six estimates in the order of `ESTIMATES`, then the target. Alpha is 255 where the pixel is valid;
elsewhere colour and alpha are 0.
"""

import collections
import dataclasses
import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from fourd.errors import InputError
from fourd.io import Archive

# (archive, key): the order in which training feeds the six streams (figures 8 and 9).
ESTIMATES = (
    ("foreground", "consensus"),
    ("foreground", "closest"),
    ("foreground", "median"),
    ("background", "farthest"),
    ("background", "median"),
    ("foreground", "farthest"),
)
TRAINING_STREAMS = (0, 1, 2, 3, 4, 5)
TARGET = 6
MIN_VALID_SHARE = 0.5
MAX_OPEN_ARCHIVES = 32
# First entries of the seeds of what is drawn, so that order and crops are independent.
_ORDER, _AUGMENTATION = 0, 1

ReadTarget = Callable[[str, int], tuple[np.ndarray, np.ndarray]]


@dataclasses.dataclass(frozen=True)
class SampleId:
    """One camera at one frame of the scene, and the files that hold its estimates."""

    cam: str
    frame: int
    foreground: Path
    background: Path


def reduce_image(rgb: np.ndarray, valid: np.ndarray, factor: int) -> np.ndarray:
    """(ceil(H / factor), ceil(W / factor), 4) uint8 RGBA: area means over valid pixels only.

    rgb: (H, W, 3) uint8;  valid: (H, W) bool
    A reduced pixel is valid if at least half of its area inside the picture is. Integer
    arithmetic, rounded to nearest.
    """
    if factor == 1:
        alpha = 255 * valid[..., None].astype(np.uint8)
        return np.concatenate([rgb & alpha, alpha], axis=2)
    height, width = valid.shape
    bottom, right = -height % factor, -width % factor
    mask = np.pad(valid, ((0, bottom), (0, right)))
    colour = np.pad(rgb * valid[..., None].astype(np.uint8), ((0, bottom), (0, right), (0, 0)))
    inside = np.pad(np.ones_like(valid), ((0, bottom), (0, right)))
    blocks = (mask.shape[0] // factor, factor, mask.shape[1] // factor, factor)
    count = mask.reshape(blocks).sum(axis=(1, 3), dtype=np.uint32)
    area = inside.reshape(blocks).sum(axis=(1, 3), dtype=np.uint32)
    total = colour.reshape(*blocks, 3).sum(axis=(1, 3), dtype=np.uint32)
    keep = (count > 0) & (count >= MIN_VALID_SHARE * area)
    divisor = np.maximum(count, 1)[..., None]
    mean = np.where(keep[..., None], (total + divisor // 2) // divisor, 0)
    return np.concatenate([mean, 255 * keep[..., None]], axis=2).astype(np.uint8)


def reduction_factor(level: int, num_levels: int) -> int:
    """How many output pixels a side one pixel of a level covers. Raises InputError."""
    if not 0 <= level < num_levels:
        raise InputError(
            f"expected a level in 0..{num_levels - 1}, got {level}: give --level and --num-levels"
        )
    return 2 ** (num_levels - 1 - level)


def streams_from_images(images: np.ndarray, order: Sequence[int]) -> torch.Tensor:
    """(1, 6, 4, H, W) float32 in [0, 1], the network's input, from (N, H, W, 4) images 0-255."""
    chosen = torch.from_numpy(np.ascontiguousarray(images[list(order)]))
    return chosen.permute(0, 3, 1, 2).unsqueeze(0).to(torch.float32) / 255


def target_from_images(images: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Target (1, 3, H, W) float32 in [0, 1] and its validity (1, 1, H, W) bool."""
    target = torch.from_numpy(np.ascontiguousarray(images[TARGET])).permute(2, 0, 1).unsqueeze(0)
    return target[:, :3].to(torch.float32) / 255, target[:, 3:] > 0


def sample_order(num_samples: int, epoch: int, seed: int) -> list[int]:
    """Permutation of the samples in an epoch; a function of its arguments alone."""
    return np.random.default_rng([_ORDER, seed, epoch]).permutation(num_samples).tolist()


def augment(
    images: np.ndarray, crop: int | None, scales: tuple[float, float], seed: int, step: int
) -> np.ndarray:
    """A random crop of the randomly resized sample, the same for all its images.

    images: (N, H, W, 4) uint8, 0 where invalid
    crop: side of the crop, px, at most the resized picture and at most the picture; None = as large as that
    scales: the factor is uniform between these two
    Returns (N, h, w, 4) float32, 0-255, alpha 0 or 255. A function of its arguments alone, so that
    training resumed at a step draws what it would have drawn.
    """
    height, width = images.shape[1:3]
    rng = np.random.default_rng([_AUGMENTATION, seed, step])
    scale = rng.uniform(*scales)
    out_h, out_w = (min(max(1, int(side * min(scale, 1))), crop or side) for side in (height, width))
    top, left = rng.uniform(size=2) * (height - out_h / scale, width - out_w / scale)
    if scales == (1.0, 1.0):
        y, x = round(top), round(left)
        return images[:, y : y + out_h, x : x + out_w].astype(np.float32)
    # Only what is seen is resampled, with a pixel around it for the interpolation.
    y0, x0 = max(0, int(top) - 1), max(0, int(left) - 1)
    seen = images[:, y0 : int(top + out_h / scale) + 3, x0 : int(left + out_w / scale) + 3]
    shift = 0.5 / scale - 0.5
    source_from_out = np.array([[1 / scale, 0, left - x0 + shift], [0, 1 / scale, top - y0 + shift]])
    return np.stack([_resample(image, source_from_out, (out_w, out_h)) for image in seen])


def _resample(image: np.ndarray, source_from_out: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Bilinear (h, w, 4) float32; colours, 0 where invalid, are averaged over valid pixels only."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(
        image.astype(np.float32), source_from_out, size, flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    share = warped[..., 3:] / 255
    valid = share >= MIN_VALID_SHARE
    colour = np.where(valid, warped[..., :3] / np.maximum(share, MIN_VALID_SHARE), 0)
    return np.concatenate([colour, 255 * valid.astype(np.float32)], axis=2)


class SampleSet:
    """The samples of a scene at one level, read when asked for.

    foreground, background: archives of every camera and chunk
    read_target: (cam, frame) -> (H, W, 3) uint8 and (H, W) bool, the camera's own frame as its
                 ideal pinhole sees it
    factor:      see `reduction_factor`
    cache_mb:    bound on the samples kept in memory. The first that fit stay: under a random order
                 the least recently used one is as likely to be needed next as any other.
    Raises InputError where an archive is not one of this workflow, belongs together with none, or
    nothing is left to train on.
    """

    def __init__(
        self,
        foreground: Sequence[Path],
        background: Sequence[Path],
        read_target: ReadTarget,
        factor: int,
        cache_mb: int,
    ) -> None:
        self._archives: collections.OrderedDict[Path, Archive] = collections.OrderedDict()
        self._read_target, self._factor = read_target, factor
        self._cache: dict[SampleId, np.ndarray] = {}
        self._cache_free = cache_mb * 2**20
        self.ids = self._pair(foreground, background)

    def __len__(self) -> int:
        return len(self.ids)

    def images(self, sample: SampleId) -> np.ndarray:
        """(7, H, W, 4) uint8, see the module's docstring. Treat as read-only."""
        if sample not in self._cache:
            images = self._load(sample)
            if images.nbytes > self._cache_free:
                return images
            self._cache_free -= images.nbytes
            self._cache[sample] = images
        return self._cache[sample]

    def fill_cache(self) -> int:
        """Read samples in order, which is cheap in videos, until the cache is full; how many are in it."""
        for sample in self.ids:
            self.images(sample)
            if sample not in self._cache:
                break
        return len(self._cache)

    def _load(self, sample: SampleId) -> np.ndarray:
        background = self._open(sample.background)
        shared = background.meta.get("same_as", {}).get(str(sample.frame), sample.frame)
        places = {
            "foreground": (self._open(sample.foreground), sample.frame),
            "background": (background, int(shared)),
        }
        stack = [self._estimate(*places[kind], key) for kind, key in ESTIMATES]
        stack.append(reduce_image(*self._read_target(sample.cam, sample.frame), self._factor))
        shapes = {image.shape for image in stack}
        if len(shapes) > 1:
            raise InputError(
                f"camera {sample.cam}, frame {sample.frame}: expected estimates and target of one size, got "
                f"{sorted(shapes)} in {sample.foreground}, {sample.background}: run fuse and background again"
            )
        return np.stack(stack)

    def _estimate(self, archive: Archive, frame: int, key: str) -> np.ndarray:
        names = [f"{frame:06d}/{key}_{part}" for part in ("rgb", "valid")]
        missing = [name for name in names if name not in archive]
        if missing:
            raise InputError(
                f"expected {missing[0]} in {archive.path}, found none: training needs every estimate of a "
                "physical camera; run fuse and background for it again"
            )
        rgb = archive.read(names[0], np.uint8, (None, None, 3))
        return reduce_image(rgb, archive.read(names[1], bool, rgb.shape[:2]), self._factor)

    def _open(self, path: Path) -> Archive:
        if path not in self._archives:
            self._archives[path] = Archive(path)
            if len(self._archives) > MAX_OPEN_ARCHIVES:
                self._archives.popitem(last=False)[1].close()
        self._archives.move_to_end(path)
        return self._archives[path]

    def _pair(self, foreground: Sequence[Path], background: Sequence[Path]) -> list[SampleId]:
        backgrounds: dict[tuple[str, int], Path] = {}
        for path in background:
            archive = self._open(path)
            frames = [*archive.frames(), *map(int, archive.meta.get("same_as", {}))]
            backgrounds.update({(_view_name(archive), frame): path for frame in frames})
        ids = []
        for path in foreground:
            archive = self._open(path)
            for frame in archive.frames():
                key = (_view_name(archive), frame)
                if key not in backgrounds:
                    raise InputError(
                        f"expected the background of camera {key[0]}, frame {frame}, with its foreground "
                        f"{path}, found none: give the background archive of the same frames"
                    )
                ids.append(SampleId(*key, path, backgrounds[key]))
        if not ids:
            raise InputError(
                "expected at least one frame to train on, got none: the foreground archives are empty; "
                f"see the reasons in {', '.join(map(str, foreground)) or 'the list of --foreground'}"
            )
        return sorted(ids, key=lambda sample: (sample.cam, sample.frame))


def _view_name(archive: Archive) -> str:
    if "view" not in archive.meta:
        raise InputError(f"expected `view` in the meta of {archive.path}, found none: run its stage again")
    return archive.meta["view"]


def split_validation(
    ids: Sequence[SampleId], num_wanted: int, cam: str | None = None
) -> tuple[list[SampleId], list[SampleId]]:
    """Samples to train on and samples kept apart, evenly spread over cameras and frames.

    At most a tenth is kept apart, so a tiny set is trained on whole. cam: a camera that is not trained on
    at all; the samples kept apart are of its frames, as many as wanted.
    Raises InputError for a camera without samples, or the only one.
    """
    if cam is not None:
        of_camera = [sample for sample in ids if sample.cam == cam]
        if not of_camera or len(of_camera) == len(ids):
            raise InputError(
                f"expected validation_camera to be one of several input cameras, got {cam!r} of "
                f"{sorted({sample.cam for sample in ids})}: change it in the configuration"
            )
        others = [sample for sample in ids if sample.cam != cam]
        return others, spread_over(of_camera, min(num_wanted, len(of_camera)))
    apart = spread_over(ids, min(num_wanted, len(ids) // 10))
    return [sample for sample in ids if sample not in apart], apart


def spread_over(ids: Sequence[SampleId], num: int) -> list[SampleId]:
    """So many of the samples, evenly spread."""
    return [ids[int((i + 0.5) * len(ids) / num)] for i in range(num)]


def fingerprint(facts: Mapping[str, object], files: Sequence[Path]) -> str:
    """Hex digest of settings and of the content of files, to tell whether work can be continued.

    Of an archive the checksums in its directory are read, not its gigabytes. File names count,
    folders do not. Raises InputError if a file is missing.
    """
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for path in files:
        if not path.is_file():
            raise InputError(f"expected a file at {path}, found nothing: check the path")
        digest.update(path.name.encode())
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                members = [(member.filename, member.CRC) for member in archive.infolist()]
            digest.update(json.dumps(members).encode())
        else:
            digest.update(path.read_bytes())
    return digest.hexdigest()
