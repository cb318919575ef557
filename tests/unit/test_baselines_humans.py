"""People: joined across views, triangulated, a body fitted and drawn; real networks if at hand."""

import dataclasses
import importlib.util

import numpy as np
import pytest

from fourd.baselines import METHODS, Unavailable
from fourd.baselines.humans import load_models, missing_models
from fourd.baselines.humans.body import LIMB_BONES, NUM_PARAMETERS, TURNS, BodyModel, read_body
from fourd.baselines.humans.fit import fit_parameters, is_plausible
from fourd.baselines.humans.mesh import colour_surface, draw_depth
from fourd.baselines.humans.people import Person, find_people
from fourd.baselines.humans.pose import NUM_LANDMARKS, Pose, _tiles
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.evaluate.people import read_people
from fourd.geometry import look_at
from fourd.io import ArchiveWriter
from tests.conftest import REPOSITORY
from tests.unit.baseline_evidence import make_evidence

MODELS = REPOSITORY / "data" / "humans"
SIZE = (320, 240)
K = np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])


@pytest.fixture(scope="module")
def body() -> BodyModel:
    if not (MODELS / "body").is_dir():
        pytest.skip(f"needs the body: python -m fourd.fetch humans --output {MODELS}")
    return read_body(MODELS / "body")


def ring(count: int, radius: float = 5.0, span_deg: float = 120) -> dict[str, Camera]:
    cameras = {}
    for i, angle in enumerate(np.radians(np.linspace(0, span_deg, count))):
        center = np.array([radius * np.sin(angle), 0.3 * (i % 2), radius * np.cos(angle)])
        R, t = look_at(center, np.zeros(3), np.array([0.0, 1.0, 0.0]))
        cameras[f"cam{i}"] = Camera(K, R, t, SIZE)
    return cameras


def landmarks(seed: int, place: tuple[float, float, float]) -> np.ndarray:
    """(33, 3) points as tall as a person."""
    spread = np.random.default_rng(seed).uniform(-1, 1, (NUM_LANDMARKS, 3)) * [0.4, 0.85, 0.2]
    return spread + place


def film(points: np.ndarray, camera: Camera, noise_px: float = 0.0, seed: int = 0) -> Pose:
    noise = np.random.default_rng(seed).normal(0, noise_px, (NUM_LANDMARKS, 2))
    return Pose(camera.project(points)[0] + noise, np.ones(NUM_LANDMARKS), 1.0)


def test_persons_are_joined_across_views_whatever_their_order_and_nobody_is_left_out():
    cameras = ring(5)
    truth = [landmarks(1, (0.6, 0, 0)), landmarks(2, (-0.7, 0, 0.3))]
    poses = {}
    for i, (name, camera) in enumerate(cameras.items()):
        shown = [film(points, camera, 0.7, i) for points in truth]
        nobody = film(landmarks(50 + i, (0.1 * i, 0.3, 0)), camera)
        poses[name] = [*(shown[::-1] if i % 2 else shown), nobody]
    # One of them is hidden from one camera.
    poses["cam1"].pop(1)
    people = find_people(poses, cameras)
    assert [len(person.finds) for person in people[:2]] == [5, 4]
    by_place = sorted(people[:2], key=lambda p: -np.nanmean(p.points[:, 0]))
    for person, points in zip(by_place, truth, strict=True):
        assert np.isfinite(person.points).all()
        assert np.linalg.norm(person.points - points, axis=1).max() < 0.05
    assert len(people) == 2


def test_a_swap_of_left_and_right_in_one_view_is_outvoted():
    cameras = ring(4)
    points = landmarks(3, (0, 0, 0))
    poses = {name: [film(points, camera)] for name, camera in cameras.items()}
    swapped = poses["cam2"][0].pixels.copy()
    swapped[[13, 14]] = swapped[[14, 13]]
    poses["cam2"] = [dataclasses.replace(poses["cam2"][0], pixels=swapped)]
    (person,) = find_people(poses, cameras)
    np.testing.assert_allclose(person.points, points, atol=1e-6)
    assert person.weights[13] == pytest.approx(3) and person.weights[11] == pytest.approx(4)


def test_one_view_or_hidden_landmarks_place_nothing():
    cameras = ring(3)
    points = landmarks(4, (0, 0, 0))
    alone = {"cam0": [film(points, cameras["cam0"])], "cam1": [], "cam2": []}
    assert find_people(alone, cameras) == []
    seen = np.ones(NUM_LANDMARKS)
    seen[30] = 0.1
    poses = {n: [dataclasses.replace(film(points, c), visibility=seen)] for n, c in cameras.items()}
    (person,) = find_people(poses, cameras)
    assert np.isnan(person.points[30]).all() and person.weights[30] == 0
    assert np.isfinite(np.delete(person.points, 30, axis=0)).all()


def stick_body() -> BodyModel:
    """Hips at 0, a thigh down to y = -4, a shank down to y = -8: one vertex at each joint and at the end."""
    heads = np.array([[0.0, 0, 0], [0, 0, 0], [0, -4, 0]])
    vertices = np.array([[0.0, 0, 0], [0, -4, 0], [0, -8, 0]])
    return BodyModel(
        vertices,
        np.array([[0, 1, 2]]),
        np.array([[1.0, 0, 0], [0, 0.5, 0.5], [0, 0, 1]]),
        ("Hips", "LeftUpLeg", "LeftLeg"),
        np.array([-1, 0, 1]),
        heads,
        np.array([27]),
        vertices[2:],
        np.array([2]),
        np.array([-1, 0, 0]),
    )


def test_a_bent_knee_a_longer_leg_and_a_larger_person_are_the_closed_form():
    body = stick_body()
    parameters = np.zeros(NUM_PARAMETERS)
    np.testing.assert_allclose(body.place_vertices(parameters), body.vertices)
    knee = 7 + len(LIMB_BONES) + 3 * list(TURNS).index("LeftLeg")
    parameters[knee] = np.pi / 2
    np.testing.assert_allclose(
        body.place_vertices(parameters), [[0, 0, 0], [0, -4, 0], [0, -4, -4]], atol=1e-12
    )
    parameters[7] = np.log(1.5)
    np.testing.assert_allclose(body.place_vertices(parameters)[2], [0, -6, -6], atol=1e-12)
    parameters[6], parameters[:3] = np.log(0.1), [1, 2, 3]
    np.testing.assert_allclose(body.place_marks(parameters[None])[0, 0], [1, 1.4, 2.4], atol=1e-12)


def test_the_body_is_of_human_build(body):
    height = np.ptp(body.vertices[:, 1])
    assert np.ptp(body.vertices, axis=0).argmax() == 1
    hip, knee = (body.marks[list(body.landmarks).index(mark)][1] for mark in (23, 25))
    sole = body.vertices[:, 1].min()
    assert 0.45 < (hip - sole) / height < 0.55 and 0.22 < (knee - sole) / height < 0.3
    assert body.weights.min() >= 0
    np.testing.assert_allclose(body.weights.sum(axis=1), 1)
    left = (body.landmarks > 10) & (body.landmarks % 2 == 1)
    assert (body.marks[left, 0] > 0).all()


def pose_person(body: BodyModel, seed: int) -> tuple[np.ndarray, Person]:
    rng = np.random.default_rng(seed)
    truth = np.zeros(NUM_PARAMETERS)
    truth[:3], truth[3:6], truth[6] = [2, 1, -3], rng.normal(0, 1, 3), np.log(0.105)
    truth[7:9] = [0.05, -0.04]
    truth[9:] = rng.normal(0, 0.3, NUM_PARAMETERS - 9)
    points = np.full((NUM_LANDMARKS, 3), np.nan)
    points[body.landmarks] = body.place_marks(truth[None])[0]
    return truth, Person(points, np.full(NUM_LANDMARKS, 3.0), (("cam0", 0), ("cam1", 0)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_posed_body_is_found_again_from_its_landmarks(body, seed):
    truth, person = pose_person(body, seed)
    found = fit_parameters(body, person)
    height = np.ptp(body.vertices[:, 1]) * np.exp(truth[6])
    misses = np.linalg.norm(body.place_marks(found[None])[0] - person.points[body.landmarks], axis=1)
    assert np.median(misses) < 0.01 * height
    surface = np.linalg.norm(body.place_vertices(found) - body.place_vertices(truth), axis=1)
    assert np.median(surface) < 0.025 * height
    assert is_plausible(body, person, found, found)


def test_a_missing_arm_and_one_wild_landmark_do_not_spoil_the_rest(body):
    truth, person = pose_person(body, 5)
    points = person.points.copy()
    points[[13, 15, 17, 19]] = np.nan
    points[28] += 0.6
    found = fit_parameters(body, dataclasses.replace(person, points=points))
    trunk = np.isin(body.landmarks, [11, 12, 23, 24, 25])
    misses = np.linalg.norm(body.place_marks(found[None])[0] - person.points[body.landmarks], axis=1)
    assert misses[trunk].max() < 0.03 * 1.75


def test_what_is_no_person_is_refused(body):
    truth, person = pose_person(body, 6)
    fit = fit_parameters(body, person)
    giant, stretched = truth.copy(), truth.copy()
    giant[6] += 1
    stretched[7] = 0.5
    assert not is_plausible(body, person, fit, giant)
    assert not is_plausible(body, dataclasses.replace(person, points=np.full((33, 3), np.nan)), fit, fit)
    assert not is_plausible(body, person, stretched, stretched)


def test_a_drawn_triangle_has_the_depth_of_its_plane():
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)
    # The plane z = 4 + x / 2.
    vertices = np.array([[-1.0, -1, 3.5], [1, -1, 4.5], [0, 1, 4], [0, 0, -1]])
    surface = draw_depth(vertices, np.array([[0, 1, 2], [0, 1, 3]]), camera)
    shown = np.isfinite(surface)
    rows, columns = np.nonzero(shown)
    points = camera.unproject(np.stack([columns, rows], axis=1).astype(float), surface[shown].astype(float))
    np.testing.assert_allclose(points[:, 2], 4 + points[:, 0] / 2, rtol=1e-5)
    inside = np.floor(camera.project(vertices[:3].mean(axis=0))[0]).astype(int)
    assert shown[inside[1], inside[0]]
    corners = camera.project(vertices[:3])[0]
    area = abs(np.linalg.det(corners[1:] - corners[0])) / 2
    assert shown.sum() == pytest.approx(area, rel=0.02)


def test_colours_come_from_the_nearest_camera_that_sees_the_surface():
    back = np.array([[-1.0, -1, 5], [1, -1, 5], [1, 1, 5], [-1, 1, 5]])
    front = back * [0.2, 1, 1] - [0, 0, 1.5]
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    vertices = np.concatenate([back, front])
    view = Camera(K, np.eye(3), np.zeros(3), SIZE)
    inputs = {}
    for name, x, colour in (("near", -0.1, 50), ("far", -1.0, 200)):
        camera = dataclasses.replace(view, t=np.array([-x, 0, 0]))
        inputs[name] = (np.full((240, 320, 3), colour, np.uint8), np.ones((240, 320), bool), camera)
    image, shown = colour_surface(vertices, faces, view, inputs)
    column, row = np.floor(view.project(np.array([0.5, 0, 5]))[0]).astype(int)
    assert image[row, column, 0] == 50 and not image[~shown].any()
    # From the far camera alone the front one hides this point, whose colour is then not the front's.
    camera = inputs["far"][2]
    picture = np.where(np.isfinite(draw_depth(front, faces[:2], camera)), 90, 200).astype(np.uint8)
    picture = np.repeat(picture[..., None], 3, axis=2)
    image, _ = colour_surface(vertices, faces, view, {"far": (picture, inputs["far"][1], camera)})
    middle = np.floor(view.project(np.array([0.0, 0, 3.5]))[0]).astype(int)
    edge = np.floor(view.project(np.array([-0.9, 0, 5]))[0]).astype(int)
    assert image[middle[1], middle[0], 0] == 90 and image[edge[1], edge[0], 0] == 200
    assert 90 < image[row, column, 0] < 200


def test_without_models_the_row_says_why(tmp_path):
    with pytest.raises(Unavailable, match="no models are given: install the extra `humans`"):
        METHODS["sfm_humans"](make_evidence())
    assert "no folder" in str(missing_models(str(tmp_path)))
    (tmp_path / "pose").mkdir()
    (tmp_path / "body").mkdir()
    reason = missing_models(str(tmp_path))
    assert reason is None or "ai-edge-litert is not installed" in reason
    (tmp_path / "pose" / "pose_detection.tflite").write_bytes(b"other")
    with pytest.raises(InputError, match="pose_detection.tflite with SHA-256"):
        load_models(str(tmp_path))


def test_fits_of_the_people_are_drawn_over_the_points(body):
    """A body 3 units ahead, fitted elsewhere: no network is needed to draw it."""
    fit = np.zeros((1, NUM_PARAMETERS))
    fit[0, 6] = np.log(2 / np.ptp(body.vertices[:, 1]))
    fit[0, 2] = 3.0
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (200, 2)), np.full(200, 3.0)])
    evidence = make_evidence(points=points, people=np.zeros((0, NUM_PARAMETERS)), humans=str(MODELS))
    without = METHODS["sfm_humans"](evidence)
    np.testing.assert_array_equal(without, METHODS["sfm_dense"](evidence))
    drawn = METHODS["sfm_humans"](dataclasses.replace(evidence, people=fit))
    changed = (drawn != without).any(axis=2)
    rows, columns = np.nonzero(changed)
    assert 0.02 < changed.mean() < 0.6
    middle = evidence.camera.project(np.array([0.0, 0, 3]))[0]
    assert abs(columns.mean() - middle[0]) < 8


def test_people_are_read_with_the_reason_where_there_are_none(tmp_path):
    assert read_people(None, "")[1].startswith("no models are given")
    assert "python -m fourd.evaluate people" in read_people(None, str(tmp_path))[1]
    with ArchiveWriter(tmp_path / "none.npz", {"status": "no folder x"}):
        pass
    assert read_people(tmp_path / "none.npz", "x") == ({}, "no folder x")
    with ArchiveWriter(tmp_path / "people.npz", {"status": "ok"}) as writer:
        writer.add_frame(7, fits=np.ones((2, NUM_PARAMETERS)))
    fits, reason = read_people(tmp_path / "people.npz", "x")
    assert list(fits) == [7] and fits[7].shape == (2, NUM_PARAMETERS) and reason == ""


def test_squares_cover_the_picture_and_overlap_by_half():
    for shape in ((270, 480), (480, 270), (200, 200)):
        tiles = _tiles(shape)
        smallest = min(side for _, _, side in tiles)
        for share in (0.0, 0.37, 0.5, 0.8, 1.0):
            y, x = share * (shape[0] - 1), share * (shape[1] - 1)
            assert any(
                left <= x <= left + side and top <= y <= top + side
                for left, top, side in tiles
                if side == smallest
            )


def test_a_person_of_the_demo_is_found(body):
    if importlib.util.find_spec("ai_edge_litert") is None:
        pytest.skip("needs the package ai-edge-litert (extra humans)")
    picture = REPOSITORY / "data" / "demo" / "frames" / "cam03" / "000010.png"
    if not picture.is_file():
        pytest.skip("needs the frames of the demo: snakemake --cores 2 demo_frames")
    from fourd.io import read_image

    image = read_image(picture)
    labels = read_image(picture.parents[2] / "truth" / "labels" / "cam03" / picture.name)[..., 0]
    poses = load_models(str(MODELS)).network.find(image)
    assert poses and poses[0].score > 0.9
    x, y = np.floor(poses[0].pixels[[11, 12, 23, 24, 25, 26]] + 0.5).astype(int).T
    assert (labels[y, x] > 0).mean() > 0.8
