import dataclasses
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.sfm.importers import detect_format, read_calibration
from tests.unit.sfm_rig import LENS, POINTS, as_tracks, assert_same_views, make_rig, moved_rig


def colmap_parameters(model: str, camera: Camera) -> list[float]:
    (fx, _, cx), (_, fy, cy), _ = camera.K
    k1, k2, p1, p2, _ = camera.distortion
    center = [cx + 0.5, cy + 0.5]
    return {
        "SIMPLE_PINHOLE": [fx, *center],
        "PINHOLE": [fx, fy, *center],
        "SIMPLE_RADIAL": [fx, *center, k1],
        "RADIAL": [fx, *center, k1, k2],
        "OPENCV": [fx, fy, *center, k1, k2, p1, p2],
    }[model]


def limit_to_model(model: str, camera: Camera) -> Camera:
    """The camera with only the parameters that a COLMAP model has."""
    kept = {"SIMPLE_PINHOLE": 0, "PINHOLE": 0, "SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4}[model]
    K = camera.K.copy()
    if model not in ("PINHOLE", "OPENCV"):
        K[1, 1] = K[0, 0]
    lens = np.where(np.arange(5) < kept, camera.distortion, 0)
    return dataclasses.replace(camera, K=K, distortion=lens)


def write_colmap(folder: Path, images: dict[str, Camera], model: str, is_text: bool) -> Path:
    import pycolmap

    folder.mkdir(parents=True)
    reconstruction = pycolmap.Reconstruction()
    for i, (name, camera) in enumerate(images.items(), start=1):
        width, height = camera.size
        parameters = colmap_parameters(model, camera)
        reconstruction.add_camera_with_trivial_rig(
            pycolmap.Camera(model=model, width=width, height=height, params=parameters, camera_id=i)
        )
        pixels = camera.project(POINTS)[0] + 0.5
        points2D = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels])
        image = pycolmap.Image(name=name, camera_id=i, image_id=i, points2D=points2D)
        cam_from_world = pycolmap.Rigid3d(np.column_stack([camera.R, camera.t]))
        reconstruction.add_image_with_trivial_frame(image, cam_from_world)
    for row, point in enumerate(POINTS):
        track = pycolmap.Track()
        for i in range(1, len(images) + 1):
            # Every fourth point is seen by the first two images alone.
            if row % 4 or i <= 2:
                track.add_element(i, row)
        reconstruction.add_point3D(point, track, np.zeros(3, np.uint8))
    (reconstruction.write_text if is_text else reconstruction.write_binary)(str(folder))
    return folder


@pytest.mark.parametrize("is_text", [True, False])
@pytest.mark.parametrize("model", ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"])
def test_colmap_models_round_trip(tmp_path, model, is_text):
    cameras = {name: limit_to_model(model, c) for name, c in make_rig(3, distortion=LENS).items()}
    folder = write_colmap(tmp_path / "model", {f"{n}.png": c for n, c in cameras.items()}, model, is_text)
    imported = read_calibration(folder)
    assert_same_views(imported.cameras, as_tracks(cameras))
    np.testing.assert_allclose(imported.points, POINTS, atol=1e-9)
    np.testing.assert_array_equal(imported.num_observations["cam01"], np.ones(len(POINTS)))
    np.testing.assert_array_equal(imported.num_observations["cam02"], np.arange(len(POINTS)) % 4 != 0)


def test_convention_colmap_pixel_centers_are_moved_by_half(tmp_path):
    import pycolmap

    camera = limit_to_model("OPENCV", make_rig(2, distortion=LENS)["cam00"])
    folder = write_colmap(tmp_path / "model", {"a.png": camera, "b.png": camera}, "OPENCV", True)
    image = next(iter(pycolmap.Reconstruction(str(folder)).images.values()))
    theirs = np.array([image.project_point(point) for point in POINTS])
    np.testing.assert_allclose(read_calibration(folder).cameras["a"][0].project(POINTS)[0], theirs - 0.5)


def test_colmap_without_rigs_is_read_and_found_below_the_project_folder(tmp_path):
    cameras = {name: limit_to_model("PINHOLE", c) for name, c in make_rig(2).items()}
    images = {f"images/{n}.png": c for n, c in cameras.items()}
    folder = write_colmap(tmp_path / "sparse" / "0", images, "PINHOLE", False)
    for name in ("rigs.bin", "frames.bin"):
        (folder / name).unlink()
    assert detect_format(tmp_path) == ("colmap", folder)
    assert detect_format(folder / "images.bin") == ("colmap", folder)
    assert_same_views(read_calibration(tmp_path).cameras, as_tracks(cameras))
    assert_same_views(read_calibration(tmp_path, "colmap").cameras, as_tracks(cameras))


def test_colmap_folders_of_numbered_images_are_moving_cameras(tmp_path):
    tracks = moved_rig(3, num_cameras=2)
    images = {
        f"{name}/{i + 1:06d}.png": camera for name, track in tracks.items() for i, camera in enumerate(track)
    }
    # The order in the file says nothing.
    shuffled = dict(sorted(images.items(), key=lambda item: item[0][::-1]))
    imported = read_calibration(write_colmap(tmp_path / "model", shuffled, "PINHOLE", False))
    assert_same_views(imported.cameras, tracks)
    assert imported.image_numbers == {"cam00": (1, 2, 3), "cam01": (1, 2, 3)}


def test_colmap_fisheye_is_refused_by_name(tmp_path):
    import pycolmap

    folder = write_colmap(tmp_path / "model", {"a.png": make_rig(2)["cam00"]}, "PINHOLE", True)
    text = (folder / "cameras.txt").read_text()
    fisheye = text.replace("PINHOLE", "OPENCV_FISHEYE").rstrip() + " 0 0 0 0\n"
    (folder / "cameras.txt").write_text(fisheye)
    assert pycolmap.Reconstruction(str(folder)).num_images() == 1
    with pytest.raises(
        InputError,
        match=r"image a\.png: expected one of the camera models SIMPLE_PINHOLE.*got OPENCV_FISHEYE",
    ):
        read_calibration(folder)


@pytest.mark.parametrize("damaged", ["cameras", "images", "points3D"])
def test_damaged_colmap_text_is_refused(tmp_path, damaged):
    images = {f"{n}.png": c for n, c in make_rig(2).items()}
    folder = write_colmap(tmp_path / "model", images, "PINHOLE", True)
    (folder / f"{damaged}.txt").write_text("1 x y\n")
    with pytest.raises(InputError, match="expected a whole COLMAP model in .*model"):
        read_calibration(folder)


@pytest.mark.parametrize("kept", [0.0, 0.2, 0.5, 0.99])
@pytest.mark.parametrize("damaged", ["cameras", "images", "points3D"])
def test_cut_colmap_binaries_are_refused_by_name(tmp_path, damaged, kept):
    images = {f"{n}.png": c for n, c in make_rig(2).items()}
    folder = write_colmap(tmp_path / "model", images, "PINHOLE", False)
    path = folder / f"{damaged}.bin"
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=rf"expected a whole COLMAP model in .*model, but {damaged}\.bin"):
        read_calibration(folder)
    path.write_bytes(data + b"tail")
    with pytest.raises(InputError, match=rf"{damaged}\.bin"):
        read_calibration(folder)


def test_pycolmap_after_opencv_leaves_png_writing_alone(tmp_path):
    # The other order of imports aborts the process inside libpng.
    folder = write_colmap(
        tmp_path / "model", {f"{n}.png": c for n, c in make_rig(2).items()}, "PINHOLE", False
    )
    code = (
        "import sys, numpy as np\n"
        "from fourd.sfm.importers import read_calibration\n"
        "read_calibration(sys.argv[1])\n"
        "from fourd.io import write_png\n"
        "write_png(sys.argv[2], np.zeros((8, 8, 3), np.uint8))\n"
    )
    subprocess.run([sys.executable, "-c", code, str(folder), str(tmp_path / "x.png")], check=True)
    assert cv2.imread(str(tmp_path / "x.png")) is not None


def test_png_can_be_written_in_a_process_that_read_a_colmap_model(tmp_path):
    """pycolmap imported before OpenCV breaks the next PNG (double free in libpng): the order matters."""
    program = (
        "import sys, numpy as np\n"
        "from pathlib import Path\n"
        "from fourd.errors import InputError\n"
        "from fourd.sfm.importers import read_calibration\n"
        "try:\n"
        "    read_calibration(sys.argv[1], 'colmap')\n"
        "except InputError as error:\n"
        "    print(error)\n"
        "assert 'pycolmap' in sys.modules\n"
        "from fourd.io import read_image, write_png\n"
        "write_png(sys.argv[2], np.zeros((4, 4, 3), np.uint8))\n"
        "assert read_image(sys.argv[2]).shape == (4, 4, 3)\n"
    )
    model = tmp_path / "model"
    model.mkdir()
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").write_text("# empty\n")
    result = subprocess.run(
        [sys.executable, "-c", program, str(model), str(tmp_path / "a.png")],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    assert result.returncode == 0, result.stdout + result.stderr
