"""The GLB animation, and rendered frames with depth and provenance."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fourd import views
from fourd.camera import Camera
from fourd.export.event import Event
from fourd.export.formats import write_format
from fourd.export.frames import (
    camera_attributes,
    linear_light,
    read_exr,
    run_frames,
    write_exr,
)
from fourd.io import ArchiveWriter, read_json, write_png
from fourd.provenance import CONTINUED, NOTHING, PAIRS, STATIC, find_provenance
from tests.unit.export_event import (
    NUM_FRAMES,
    ORIGIN,
    POINTS,
    SCALE,
    colour_of,
    make_event,
    make_scene,
    source_camera,
)


@pytest.fixture(scope="module")
def event(tmp_path_factory: pytest.TempPathFactory) -> Event:
    return make_event(tmp_path_factory.mktemp("event"))


@pytest.fixture(scope="module")
def glb(event: Event, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("glb")
    write_format(event, "glb", folder)
    return folder / "event.glb"


def read_glb(path: Path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    magic, version, total = struct.unpack_from("<III", data)
    length, kind = struct.unpack_from("<II", data, 12)
    assert (magic, version, total, kind) == (0x46546C67, 2, len(data), 0x4E4F534A)
    start = 20 + length
    size, kind = struct.unpack_from("<II", data, start)
    assert kind == 0x004E4942 and start + 8 + size == len(data)
    return json.loads(data[20:start]), data[start + 8 :]


def array_of(document: dict, body: bytes, index: int) -> np.ndarray:
    entry = document["accessors"][index]
    view = document["bufferViews"][entry["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    dtype = {5126: "<f4", 5123: "<u2"}[entry["componentType"]]
    flat = np.frombuffer(body, dtype, entry["count"] * width, view["byteOffset"])
    return flat.reshape(entry["count"], width)


def test_glb_cameras_move_as_they_did_and_project_by_gltf(event: Event, glb: Path) -> None:
    """glTF's rule: x right, y up, looks along -z; yfov over the height."""
    document, body = read_glb(glb)
    root = document["nodes"][0]
    up = Rotation.from_quat(root["rotation"]).apply(event.scene.up)
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(root["extras"]["origin"], ORIGIN)
    nodes = {node["name"]: i for i, node in enumerate(document["nodes"])}
    animation = document["animations"][0]
    samplers = {
        (channel["target"]["node"], channel["target"]["path"]): animation["samplers"][channel["sampler"]]
        for channel in animation["channels"]
    }
    for name in event.names:
        lens = document["cameras"][document["nodes"][nodes[name]]["camera"]]["perspective"]
        turns = array_of(document, body, samplers[nodes[name], "rotation"]["output"])
        places = array_of(document, body, samplers[nodes[name], "translation"]["output"])
        for frame in range(NUM_FRAMES):
            camera = source_camera(event.scene, name, frame)
            np.testing.assert_allclose(places[frame] + ORIGIN, camera.center, atol=1e-5)
            local = Rotation.from_quat(turns[frame]).inv().apply(POINTS * SCALE - places[frame])
            tangent = np.tan(lens["yfov"] / 2)
            v = (1 - local[:, 1] / -local[:, 2] / tangent) / 2 * camera.size[1]
            expected = camera.project(POINTS * SCALE + ORIGIN)[0][:, 1] + 0.5
            # glTF's principal point is central.
            shift = camera.K[1, 2] + 0.5 - camera.size[1] / 2
            np.testing.assert_allclose(v + shift, expected, atol=1e-3)


def test_glb_points_show_at_their_frame_in_their_colours(event: Event, glb: Path) -> None:
    document, body = read_glb(glb)
    channels = document["animations"][0]["channels"]
    samplers = document["animations"][0]["samplers"]
    for frame in range(NUM_FRAMES):
        index = next(i for i, node in enumerate(document["nodes"]) if node["name"] == f"points {frame:06d}")
        channel = next(c for c in channels if c["target"] == {"node": index, "path": "scale"})
        sampler = samplers[channel["sampler"]]
        assert sampler["interpolation"] == "STEP"
        times = array_of(document, body, sampler["input"])[:, 0]
        sizes = array_of(document, body, sampler["output"])[:, 0]
        shown = [sizes[np.searchsorted(times, f / 30 + 1e-4) - 1] for f in range(NUM_FRAMES)]
        assert shown == [1.0 if f == frame else 0.0 for f in range(NUM_FRAMES)]
        mesh = document["meshes"][document["nodes"][index]["mesh"]]["primitives"][0]
        assert mesh["mode"] == 0
        xyz = array_of(document, body, mesh["attributes"]["POSITION"]) / SCALE
        linear = array_of(document, body, mesh["attributes"]["COLOR_0"])[:, :3] / 65535
        assert np.abs(xyz[:, 2]).max() < 1e-4
        np.testing.assert_allclose(linear, linear_light(colour_of(xyz.astype(np.float64))), atol=0.02)


def test_glb_is_read_by_a_public_reader(glb: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="the extra dev has it")
    scene = trimesh.load(str(glb))
    clouds = [g for g in scene.geometry.values() if isinstance(g, trimesh.PointCloud)]
    assert len(clouds) == NUM_FRAMES
    assert max(np.abs(cloud.vertices[:, 2]).max() for cloud in clouds) < 1e-3


def estimates(shape=(4, 6)):
    near, far = np.zeros(shape, bool), np.ones(shape, bool)
    near[:, :3], far[0] = True, False
    foreground = {"consensus_valid": near, "depth": np.where(near, 2, np.nan).astype(np.float32)}
    foreground |= {"depth_source": np.where(near, 1, 0).astype(np.uint8)}
    foreground |= {"source": np.where(near, 4, 255).astype(np.uint8)}
    filled = np.zeros(shape, bool)
    filled[1] = True
    depth = np.where(far, np.float32(np.inf), np.nan).astype(np.float32)
    depth[2] = 5
    return foreground, {"farthest_valid": far, "depth": depth, "filled": filled}


def test_provenance_says_what_a_pixel_rests_on() -> None:
    found = find_provenance(*estimates())
    kinds = [NOTHING, CONTINUED, STATIC, STATIC]
    assert found.kind[:, 0].tolist() == [PAIRS] * 4 and found.kind[:, 5].tolist() == kinds
    assert found.source[0].tolist() == [4, 4, 4, -1, -1, -1]
    assert found.depth[2].tolist() == [2, 2, 2, 5, 5, 5] and np.isinf(found.depth[0, 5])


def test_exr_holds_light_depth_and_the_camera(tmp_path: Path) -> None:
    pytest.importorskip("OpenImageIO", reason="the extra exr has it")
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3)).astype(np.uint8)
    found = find_provenance(*estimates())
    camera = source_camera(make_scene(), "cam00", 0)
    write_exr(tmp_path / "a.exr", rgb, found, camera_attributes(camera))
    channels, document = read_exr(tmp_path / "a.exr")
    assert set(channels) == {"R", "G", "B", "Z", "provenance", "source"}
    assert np.array_equal(channels["Z"], found.depth)
    assert np.array_equal(channels["provenance"], found.kind)
    assert np.array_equal(channels["source"], found.source)
    light = np.stack([channels[c] for c in "RGB"], axis=-1)
    display = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)
    assert np.abs(255 * display - rgb).max() < 0.2
    np.testing.assert_array_equal(document["R"], camera.R)


def test_convention_exr_matrices_take_row_vectors_to_the_picture() -> None:
    camera = source_camera(make_scene(), "cam02", 1)
    attributes = camera_attributes(camera)
    points = POINTS * SCALE + ORIGIN
    rows = np.column_stack([points, np.ones(3)])
    local = rows @ attributes["worldToCamera"]
    pixels, depth = camera.project(points)
    np.testing.assert_allclose(local[:, 2], depth)
    assert (np.sign(local[:, 1]) == -np.sign(pixels[:, 1] - camera.K[1, 2])).all()
    ndc = rows @ attributes["worldToNDC"]
    np.testing.assert_allclose(ndc[:, :2] / ndc[:, 3:] * camera.size - 0.5, pixels, atol=1e-9)


@pytest.mark.parametrize("picture_format", ["exr", "png16"])
def test_frames_of_a_film(tmp_path: Path, picture_format: str) -> None:
    if picture_format == "exr":
        pytest.importorskip("OpenImageIO", reason="the extra exr has it")
    scene = make_scene((6, 4))
    camera = Camera(
        np.array([[5.0, 0, 2.5], [0, 5, 1.5], [0, 0, 1]]), np.eye(3), np.array([0.1, 0, 2]), (6, 4)
    )
    view = views.View(
        "film", "virtual", (6, 4), (views.ViewFrame(0, 1, camera), views.ViewFrame(1, 2, camera))
    )
    foreground, background = estimates()
    rgb = np.full((4, 6, 3), 130, np.uint8)
    with ArchiveWriter(tmp_path / "f.npz", {"view": "film", "cameras": ["cam00", "cam02"]}) as writer:
        for frame in (0, 1):
            writer.add_frame(frame, **foreground)
            write_png(tmp_path / "render" / f"{frame:06d}.png", rgb)
    meta = {"view": "film", "sample_frames": [0], "same_as": {"0": 0, "1": 0}}
    with ArchiveWriter(tmp_path / "b.npz", meta) as writer:
        writer.add_frame(0, **background)
    folder, files = tmp_path / "out", [tmp_path / "f.npz", tmp_path / "b.npz"]
    run_frames(view, scene, [tmp_path / "render"], files, picture_format, 1.0, folder)
    document = read_json(folder / "frames.json")
    assert [frame["scene_frame"] for frame in document["frames"]] == [1, 2]
    given = document["frames"][0]
    pose = Camera(np.array(given["K"]), np.array(given["R"]), np.array(given["t"]), (6, 4))
    np.testing.assert_allclose(pose.center, camera.center * SCALE + ORIGIN)
    if picture_format == "exr":
        depth = read_exr(folder / "000001.exr")[0]["Z"]
    else:
        colour = cv2.imread(str(folder / "000001.png"), cv2.IMREAD_UNCHANGED)
        assert colour.dtype == np.uint16 and (colour == 130 * 257).all()
        depth = cv2.imread(str(folder / "000001_depth.png"), cv2.IMREAD_UNCHANGED) * document["depth_step"]
    np.testing.assert_allclose(depth[2], SCALE * np.array([2, 2, 2, 5, 5, 5]), rtol=1e-6, atol=1e-3)
