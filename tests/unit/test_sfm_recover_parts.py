"""The parts of camera recovery by themselves, where answers are known in closed form."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.geometry import look_at
from fourd.sfm.compare import align_similarity, fit_similarity
from fourd.sfm.recover.adjust import adjust
from fourd.sfm.recover.diagnose import describe_geometry
from fourd.sfm.recover.evidence import choose_lens, sub_model
from fourd.sfm.recover.features import find_features
from fourd.sfm.recover.frames import adjust_films, bridge_gaps, longest_run
from fourd.sfm.recover.mapping import Features, map_keyframes, match_keyframes
from fourd.sfm.recover.model import Lens, Model, to_reconstruction
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.patches import align_patches, extract_templates
from fourd.sfm.recover.register import register_remaining, replace_poses
from fourd.sfm.recover.starts import rank_starts
from fourd.sfm.recover.tracking import affine_between, cut_landmarks
from fourd.sfm.sparse import detect_features
from tests.unit.recover_films import draw_films, make_cameras
from tests.unit.sfm_rig import make_texture


def make_model(radial=(), noise_px=0.0) -> tuple[Model, np.ndarray]:
    """Three cameras of two frames that see 200 points, and the true points."""
    rng = np.random.default_rng(2)
    points = rng.uniform([-1.5, -0.5, 0], [1.5, 2.5, 2], (200, 3))
    lens = Lens((320, 240), 300.0, radial)
    poses = {}
    for i in range(3):
        for frame, camera in enumerate(make_cameras(i, 2)):
            poses[(f"cam{i}", frame)] = np.concatenate([camera.R, camera.t[:, None]], axis=1)
    obs = [np.arange(200)] * len(poses)
    image = np.repeat(np.arange(len(poses)), 200)
    model = Model(
        dict.fromkeys(("cam0", "cam1", "cam2"), lens), poses, points, image, np.concatenate(obs), None
    )
    pixels = np.concatenate([model.camera(key).project(points)[0] for key in model.images])
    pixels += rng.normal(0, 1, pixels.shape) * noise_px
    return Model(model.lenses, poses, points, image, model.obs_point, pixels), points


def test_convention_pixel_centres_move_by_a_half_into_colmap_and_back():
    model, points = make_model((0.05, -0.02))
    reconstruction = to_reconstruction(model)
    image = reconstruction.images[1]
    in_cam = image.cam_from_world() * points[:1]
    projected = reconstruction.cameras[1].img_from_cam(in_cam)
    np.testing.assert_allclose(projected, model.obs_px[:1] + 0.5, atol=1e-9)
    np.testing.assert_allclose(image.points2D[0].xy, model.obs_px[0] + 0.5)
    lens = model.lenses["cam0"].updated(reconstruction.cameras[1])
    assert lens == model.lenses["cam0"]
    shifted = Lens((320, 240), 300.0, (0.1,), (2.5, -1.0))
    assert shifted.updated(shifted.to_colmap(1)) == shifted
    assert shifted.at(np.eye(3), np.zeros(3)).K[:2, 2].tolist() == [162.0, 118.5]
    assert lens.at(np.eye(3), np.zeros(3)).K[0, 2] == 159.5


def test_adjustment_recovers_what_was_shaken():
    model, points = make_model()
    rng = np.random.default_rng(0)
    poses = {k: p + rng.normal(0, 1e-3, p.shape) * [[0, 0, 0, 1]] for k, p in model.poses.items()}
    shaken = Model(
        {n: Lens(lens.size, 306.0) for n, lens in model.lenses.items()},
        poses,
        points + rng.normal(0, 0.01, points.shape),
        model.obs_image,
        model.obs_point,
        model.obs_px,
    )
    found = adjust(shaken, 1.0)
    assert np.abs(found.residuals_px()).max() < 1e-3
    errors = align_similarity(
        [found.camera(k) for k in found.images], [model.camera(k) for k in model.images]
    )
    assert errors.rotation_deg.max() < 1e-3 and np.abs(errors.focal).max() < 1e-5


def test_fixed_points_stay_to_the_last_bit():
    model, points = make_model()
    one = model.select(model.obs_image == 0)
    alone = Model(
        {"cam0": Lens((320, 240), 310.0)},
        {("cam0", 0): model.poses[("cam0", 0)]},
        points,
        one.obs_image,
        one.obs_point,
        one.obs_px,
    )
    found = adjust(alone, 1.0, is_scene_fixed=True)
    np.testing.assert_array_equal(found.points, points)
    assert found.lenses["cam0"].focal_px == pytest.approx(300, abs=1e-3)


@pytest.mark.parametrize(("radial", "expected"), [((), 0), ((0.04,), 1)])
def test_the_plainest_lens_that_explains_the_points_is_chosen(radial, expected):
    model, _ = make_model(radial, noise_px=0.1)
    lens = choose_lens(sub_model(model, "cam1"), 0.3)
    assert len(lens.radial) == expected
    assert lens.focal_px == pytest.approx(300, rel=2e-3)


def described(points: np.ndarray, moves: dict[str, np.ndarray]) -> str:
    """Notes about three cameras that see `points`; `moves` shifts a camera's centre."""
    model, _ = make_model()
    poses = {}
    for key, pose in model.poses.items():
        center = -pose[:, :3].T @ pose[:, 3] + moves.get(key[0], np.zeros(3))
        poses[key] = np.concatenate([pose[:, :3], (-pose[:, :3] @ center)[:, None]], axis=1)
    return " ".join(describe_geometry(dataclasses.replace(model, poses=poses, points=points)))


def test_degenerate_geometry_is_named_and_sound_geometry_is_not():
    points = make_model()[1]
    assert described(points, {}) == ""
    assert "all points lie on one plane (a wall)" in described(points * [1, 0.002, 1], {})
    far_away = described(points, {"cam2": np.array([0.0, -40, 0])})
    assert "cam2 is " in far_away and "times as far away as the typical camera" in far_away
    # All cameras 4 in front of the scene become cameras 400 in front of it.
    assert "the cameras stand almost at one place" in described(points + [0, 400, 0], {})


def test_a_camera_joins_the_model_through_landmarks_alone():
    films, truth = draw_films(4, 1)
    options = RecoverOptions(num_keyframes=1, max_features=500)
    features = {(name, 0): Features(*detect_features(film.read_rgb(0), 500)) for name, film in films.items()}
    lenses = {name: Lens(film.size, 300.0) for name, film in films.items()}
    without = {key: value for key, value in features.items() if key[0] != "cam03"}
    pairs = match_keyframes(without, lenses, options)
    three = {name: lenses[name] for name in ("cam00", "cam01", "cam02")}
    mapped = map_keyframes(without, pairs, three, options, rank_starts(pairs)[0])
    assert mapped is not None
    model = mapped.supported().compact()
    landmarks = cut_landmarks(model, lambda name, frame: films[name].read_gray(frame), 7)
    grown = register_remaining(model, landmarks, films, features, lenses, options)
    assert grown.cameras == ["cam00", "cam01", "cam02", "cam03"]
    np.testing.assert_array_equal(grown.points, model.points)
    assert (grown.obs_image == 3).sum() >= options.min_matches
    adjusted = adjust(grown, 0.3)
    errors = align_similarity(
        [adjusted.camera(k) for k in adjusted.images], [truth[k[0]][0] for k in grown.images]
    )
    assert errors.rotation_deg[3] < 0.5
    assert register_remaining(grown, landmarks, films, features, lenses, options) is grown


def test_a_shared_lens_is_adjusted_as_one_and_given_to_who_joins():
    model, _ = make_model()
    model = dataclasses.replace(
        model, lenses=dict.fromkeys(model.lenses, Lens((320, 240), 306.0)), is_lens_shared=True
    )
    assert to_reconstruction(model).num_cameras() == 1
    found = adjust(model, 1.0)
    assert len(set(found.lenses.values())) == 1
    assert found.lenses["cam1"].focal_px == pytest.approx(300, abs=1e-2)
    other = sub_model(make_model()[0], "cam2")
    newcomer = dataclasses.replace(
        other, lenses={"new": other.lenses["cam2"]}, poses={("new", 0): np.eye(3, 4)}
    )
    joined = found.joined(newcomer.select(newcomer.obs_image == 0))
    assert joined.lenses["new"] == found.lenses["cam0"]
    assert joined.camera(joined.images[joined.obs_image[-1]]).center.tolist() == [0, 0, 0]


def test_points_of_one_camera_alone_support_nothing():
    model, _ = make_model()
    only_first = model.select((model.obs_image < 2) | (model.obs_point >= 50))
    assert only_first.supported().obs_point.min() == 50
    assert len(only_first.supported().compact().points) == 150


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.37, -1.21), (1.6, 0.5)])
def test_a_patch_is_found_to_hundredths_of_a_pixel(shift):
    texture = cv2.GaussianBlur(make_texture(256)[:, :, 0], (0, 0), 1.5).astype(np.float32)
    affine = np.array([[1.05, 0.04], [-0.03, 0.97]])
    center = np.array([128.0, 128.0])
    moved = center + shift
    matrix = np.concatenate([affine, (moved - affine @ center)[:, None]], axis=1)
    # Gain and offset of the second picture differ.
    second = 0.7 * cv2.warpAffine(texture, matrix, (256, 256), flags=cv2.INTER_CUBIC) + 20
    grid = center + np.stack(np.meshgrid([-60, -20, 20, 60], [-60, -20, 20, 60]), -1).reshape(-1, 2)
    templates, valid = extract_templates(texture, grid, 7)
    assert valid.all()
    expected = (grid - center) @ affine.T + moved
    starts = expected + np.array([0.8, -0.6])
    found, score = align_patches(second, templates, starts, np.tile(np.eye(2), (len(grid), 1, 1)), 6)
    assert (score > 0.95).all()
    assert np.abs(found - expected).max() < 0.05


def test_a_patch_that_is_flat_or_outside_has_no_score():
    image = np.full((64, 64), 9, np.float32)
    templates, valid = extract_templates(image, np.array([[32.0, 32], [3, 3]]), 7)
    assert valid.tolist() == [True, False]
    _, score = align_patches(
        image, templates, np.array([[32.0, 32], [3, 3]]), np.tile(np.eye(2), (2, 1, 1)), 6
    )
    assert score.tolist() == [-1, -1]


def test_affine_between_views_is_the_derivative_of_a_plane_that_faces_both():
    first, second = make_cameras(0, 1)[0], make_cameras(2, 1)[0]
    point = np.array([0.3, 0.2, 1.1])
    affine = affine_between(first, second, point[None])[0]
    back = affine_between(second, first, point[None])[0]
    np.testing.assert_allclose(affine @ back, np.eye(2), atol=0.02)
    np.testing.assert_allclose(affine_between(first, first, point[None])[0], np.eye(2), atol=1e-9)


def pose_at(x: float) -> np.ndarray:
    R = Rotation.from_rotvec([0, 0.01 * x, 0]).as_matrix()
    return np.concatenate([R, (-R @ [x, 0, 0])[:, None]], axis=1)


def test_short_gaps_are_bridged_on_the_way_between_their_ends():
    poses = {frame: pose_at(frame) for frame in (2, 3, 7, 12)}
    filled, added = bridge_gaps(poses, range(15))
    assert added == [4, 5, 6]
    for frame in added:
        np.testing.assert_allclose(filled[frame], pose_at(frame), atol=1e-12)
    assert longest_run(range(15), filled) == [2, 3, 4, 5, 6, 7]


def test_a_similarity_is_no_error_and_errors_are_measured():
    true = [camera for i in range(4) for camera in make_cameras(i, 3)]
    turn = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix()

    def moved(camera: Camera) -> Camera:
        R = camera.R @ turn.T
        return Camera(camera.K, R, -R @ (2.5 * turn @ camera.center + [1, 2, 3]), camera.size)

    errors = align_similarity([moved(camera) for camera in true], true)
    assert errors.rotation_deg.max() < 1e-9 and errors.center.max() < 1e-12
    assert np.abs(errors.focal).max() == 0
    np.testing.assert_allclose(errors.distance, 4, rtol=0.03)
    bent = [moved(camera) for camera in true]
    step = Rotation.from_rotvec([0, np.radians(0.6), 0]).as_matrix()
    bent[5] = Camera(1.01 * bent[5].K, step @ bent[5].R, step @ bent[5].t, bent[5].size)
    errors = align_similarity(bent, true)
    assert errors.rotation_deg[5] == pytest.approx(0.6, abs=0.06)
    assert errors.focal[5] == pytest.approx(0.01)
    with pytest.raises(ValueError, match="two equal lists"):
        align_similarity(true[:1], true[:1])


def test_a_fitted_similarity_takes_any_camera_into_the_true_world():
    true = [camera for i in range(4) for camera in make_cameras(i, 2)]
    turn = Rotation.from_rotvec([-0.2, 0.9, 2.1]).as_matrix()

    def moved(camera: Camera) -> Camera:
        R = camera.R @ turn.T
        return Camera(camera.K, R, -R @ (0.1 * turn @ camera.center + [5, -4, 3]), camera.size)

    similarity = fit_similarity([moved(camera) for camera in true[:4]], true[:4])
    assert similarity.scale == pytest.approx(10)
    points = np.random.default_rng(0).normal(0, 1, (20, 3))
    for camera in true:
        again = similarity.apply(moved(camera))
        np.testing.assert_allclose(again.project(points)[0], camera.project(points)[0], atol=1e-6)
    with pytest.raises(ValueError, match="two equal lists"):
        fit_similarity(true[:2], true[:3])


def test_centres_that_coincide_leave_only_the_rotation():
    R, t = look_at(np.array([0.0, -4, 0]), np.zeros(3), np.array([0.0, 0, 1]))
    camera = Camera(np.diag([300.0, 300, 1]), R, t, (320, 240))
    errors = align_similarity([camera, camera], [camera, camera])
    assert errors.rotation_deg.max() < 1e-9 and errors.extent == 0


def test_a_picture_in_a_wrong_pose_is_placed_anew_and_the_others_stay():
    model, _ = make_model(noise_px=0.2)
    wrong = model.images[3]
    step = Rotation.from_rotvec([0, np.radians(5), 0]).as_matrix()
    poses = {k: step @ pose if k == wrong else pose for k, pose in model.poses.items()}
    found = replace_poses(dataclasses.replace(model, poses=poses), 1.0)
    assert list(found.poses) == model.images
    for key, pose in model.poses.items():
        if key == wrong:
            np.testing.assert_allclose(found.poses[key], pose, atol=5e-3)
        else:
            np.testing.assert_array_equal(found.poses[key], pose)


def test_landmarks_off_to_one_side_in_all_frames_of_a_film_do_not_turn_the_cameras():
    model, _ = make_model(noise_px=0.02)
    truth = [make_model()[0].camera(key) for key in model.images]
    off = np.zeros_like(model.obs_px)
    off[(model.obs_image >= 4) & (model.obs_point % 4 == 0)] = [0.0, 0.5]
    bent = adjust(dataclasses.replace(model, obs_px=model.obs_px + off), 0.3)
    errors = [
        np.median(align_similarity([m.camera(key) for key in m.images], truth).rotation_deg)
        for m in (bent, adjust_films(bent, RecoverOptions()))
    ]
    assert errors[0] > 0.1
    assert errors[1] < 0.03


def test_a_picture_with_few_corners_gives_its_weak_ones_too():
    texture = cv2.GaussianBlur(make_texture(256), (0, 0), 1.5)
    faint = np.clip(128 + 0.6 * (texture.astype(np.float64) - 128), 0, 255).astype(np.uint8)
    strong, _ = detect_features(faint, 4000)
    assert len(find_features(faint, RecoverOptions()).pixels) > 2 * len(strong)
    # Where as many are allowed as there are strong ones, these stay alone.
    enough = RecoverOptions(max_features=len(strong))
    np.testing.assert_array_equal(find_features(faint, enough).pixels, strong)
