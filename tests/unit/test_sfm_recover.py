import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.align.clock import CameraClock, Offsets
from fourd.align.sampling import TOO_SHORT
from fourd.errors import InputError
from fourd.film_cameras import FilmCameras, read_film_cameras, write_film_cameras
from fourd.ingest.__main__ import main as ingest_main
from fourd.io import read_json, write_json, write_png
from fourd.sfm.__main__ import main, parse_scale_hint
from fourd.sfm.compare import align_similarity
from fourd.sfm.recover.films import focal_guess_px, select_frames
from fourd.sfm.recover.options import RecoverOptions
from fourd.sfm.recover.recover import recover_cameras
from tests.unit.recover_films import draw, draw_films, film_of, first_frames, room
from tests.unit.sfm_rig import make_texture

SCHEMA_PATH = Path(__file__).resolve().parents[2] / "config" / "schemas" / "recover.schema.yaml"
OPTIONS = RecoverOptions(num_keyframes=2, max_features=500)


def errors_of(found: FilmCameras, truth, names):
    pairs = [
        (camera, truth[name][int(frame)])
        for name in names
        for frame, camera in zip(found.cameras[name].source_frames, found.cameras[name].cameras, strict=True)
    ]
    return align_similarity([p[0] for p in pairs], [p[1] for p in pairs])


@pytest.fixture(scope="module")
def drawn():
    return draw_films()


@pytest.fixture(scope="module")
def recovered(drawn):
    return recover_cameras(drawn[0], ["cam03"], ("cam00", "cam02", true_distance(drawn[1])), OPTIONS)


def true_distance(truth, first="cam00", second="cam02") -> float:
    centers = [np.mean([c.center for c in truth[name]], axis=0) for name in (first, second)]
    return float(np.linalg.norm(centers[0] - centers[1]))


def test_options_and_schema_agree():
    schema = yaml.safe_load(SCHEMA_PATH.read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(RecoverOptions())
    assert schema["additionalProperties"] is False


def test_every_frame_of_every_film_is_placed(drawn, recovered):
    films, truth = drawn
    assert [camera.status for camera in recovered.cameras.values()] == ["ok"] * 4
    for film in recovered.cameras.values():
        assert film.source_frames.tolist() == [0, 1, 2, 3, 4] and not film.is_static
        assert film.reprojection_error_px < 0.3
        assert not film.cameras[0].is_distorted
    errors = errors_of(recovered, truth, list(films))
    assert np.median(errors.rotation_deg) < 0.1 and errors.rotation_deg.max() < 0.2
    assert np.median(errors.center / errors.distance) < 0.0025
    assert np.abs(errors.focal).max() < 0.005


def test_up_and_scale_of_the_world(recovered, drawn):
    # The world's up is the direction that the true cameras' pictures show as up.
    camera, true = recovered.cameras["cam01"].cameras[2], drawn[1]["cam01"][2]
    np.testing.assert_allclose(camera.R @ recovered.up, true.R @ [0, 0, 1], atol=0.03)
    # One distance was given; the others come out in the same metres.
    found = {name: film.cameras for name, film in recovered.cameras.items()}
    for second, tolerance in (("cam01", 0.01), ("cam02", 1e-9), ("cam03", 0.01)):
        metres = true_distance(found, "cam00", second) * recovered.metres_per_unit
        assert metres == pytest.approx(true_distance(drawn[1], "cam00", second), rel=tolerance)


def test_a_heldout_film_changes_nothing(drawn, recovered):
    films = drawn[0]
    blank = film_of("cam03", [np.full((240, 320, 3), 90, np.uint8)] * 5)
    without = recover_cameras({**films, "cam03": blank}, ["cam03"], None, OPTIONS)
    assert "constant" in without.cameras["cam03"].status
    np.testing.assert_array_equal(without.points, recovered.points)
    np.testing.assert_array_equal(without.up, recovered.up)
    for name in ("cam00", "cam01", "cam02"):
        for a, b in zip(without.cameras[name].cameras, recovered.cameras[name].cameras, strict=True):
            assert a.to_dict() == b.to_dict()


@pytest.fixture(scope="module")
def ingested(drawn, tmp_path_factory):
    """ingest/{cam}.json by camera, of the drawn films as folders of pictures."""
    folder = tmp_path_factory.mktemp("ingested")
    for name, film in drawn[0].items():
        for i, picture in enumerate(film.source.pictures):
            write_png(folder / name / f"{i:06d}.png", picture)
        flags = ["--camera", name, "--source", str(folder / name), "--fps", "30"]
        output = ["--output-json", str(folder / f"{name}.json"), "--output-table", str(folder / "t.csv")]
        ingest_main([*flags, *output])
    return {name: folder / f"{name}.json" for name in drawn[0]}


def recover_arguments(ingested, names, output, *extra) -> list[str]:
    flags = ["--num-frames", "5", "--fps", "30", "--num-keyframes", "2", "--max-features", "500"]
    paths = [str(ingested[name]) for name in names]
    return ["recover", "--camera", *names, "--ingest", *paths, "--output", str(output), *flags, *extra]


def test_the_command_line_repeats_the_bytes_with_a_scale_hint_in_words(drawn, recovered, ingested, tmp_path):
    write_film_cameras(tmp_path / "library.json", recovered)
    words = ["--heldout", "cam03", "--scale-hint", "cam00", "cam02", repr(true_distance(drawn[1]))]
    main(recover_arguments(ingested, list(ingested), tmp_path / "again.json", *words))
    assert (tmp_path / "library.json").read_bytes() == (tmp_path / "again.json").read_bytes()


def test_the_command_line_without_a_scale_hint(ingested, tmp_path):
    names = ["cam00", "cam01", "cam02"]
    # A film that is too short for the scene is not looked at.
    document = read_json(ingested["cam00"])
    short = {key: document[key][:2] for key in ("pts_s", "files")} | {"num_source_frames": 2}
    write_json(tmp_path / "cam00.json", document | short)
    paths, flags = ingested | {"cam00": tmp_path / "cam00.json"}, ["--scale-hint=none", "--start-s=none"]
    main(recover_arguments(paths, names, tmp_path / "pair.json", *flags))
    found = read_film_cameras(tmp_path / "pair.json")
    assert found.metres_per_unit is None
    assert found.cameras["cam00"].status.startswith(f"{TOO_SHORT}: it lasts 2 of 5 frames")
    assert [found.cameras[name].status for name in names[1:]] == ["ok", "ok"]


def test_a_scale_hint_needs_cameras_that_were_placed(drawn):
    blank = film_of("cam02", [np.full((240, 320, 3), 90, np.uint8)] * 2)
    films = {**first_frames(drawn[0], ("cam00", "cam01"), 2), "cam02": blank}
    with pytest.raises(InputError, match="scale_hint: expected two cameras that were placed, got cam02"):
        recover_cameras(films, [], ("cam00", "cam02", 2.0), OPTIONS)


def test_one_lens_for_all_films_is_estimated_once():
    films, truth = draw_films(3, 2)
    tracks = {n: [dataclasses.replace(c, K=truth["cam01"][0].K) for c in t] for n, t in truth.items()}
    films = {n: film_of(n, [draw(camera, room()) for camera in track]) for n, track in tracks.items()}
    found = recover_cameras(films, [], None, dataclasses.replace(OPTIONS, shared_lens=True))
    (focal_px,) = {film.cameras[0].focal_px for film in found.cameras.values()}
    assert focal_px == pytest.approx(tracks["cam00"][0].focal_px, rel=3e-3)
    assert errors_of(found, tracks, list(films)).rotation_deg.max() < 0.2
    large = film_of("cam02", [np.zeros((480, 640, 3), np.uint8)])
    with pytest.raises(InputError, match="shared_lens: expected films of one size, got 320x240, 640x480"):
        recover_cameras({**films, "cam02": large}, [], None, dataclasses.replace(OPTIONS, shared_lens=True))


def test_a_distorting_lens_is_found_where_there_is_one():
    films, truth = draw_films(3, 2, radial=-0.12)
    found = recover_cameras(films, [], None, OPTIONS)
    for film in found.cameras.values():
        assert film.cameras[0].distortion[0] == pytest.approx(-0.12, abs=0.03)
    assert errors_of(found, truth, list(films)).rotation_deg.max() < 0.3


def test_a_tripod_is_one_pose(drawn):
    still, still_truth = draw_films(1, 1)
    noisy = np.random.default_rng(0)
    picture = still["cam00"].source.read(0).astype(np.float64)
    pictures = [
        np.clip(picture + noisy.normal(0, 2, picture.shape), 0, 255).astype(np.uint8) for _ in range(5)
    ]
    films = {**first_frames(drawn[0], ("cam01", "cam02"), 3), "cam00": film_of("cam00", pictures)}
    found = recover_cameras(films, [], None, OPTIONS)
    assert found.cameras["cam00"].is_static and len(found.cameras["cam00"].cameras) == 1
    assert not found.cameras["cam01"].is_static
    truth = {**drawn[1], "cam00": still_truth["cam00"]}
    assert errors_of(found, truth, list(films)).rotation_deg.max() < 0.25


def test_a_mirrored_film_and_another_place_are_left_out_by_name(drawn):
    films = first_frames(drawn[0], drawn[0], 2)
    films["cam02"] = film_of("cam02", [p[:, ::-1].copy() for p in films["cam02"].source.pictures])
    other = np.random.default_rng(1).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    films["cam04"] = film_of("cam04", [other] * 2)
    found = recover_cameras(films, [], None, OPTIONS)
    assert found.cameras["cam02"].status.startswith("the film is mirrored")
    assert "matches no other camera" in found.cameras["cam04"].status
    assert [found.cameras[n].status for n in ("cam00", "cam01", "cam03")] == ["ok"] * 3
    assert any(note.startswith("cam02 is left out: the film is mirrored") for note in found.notes)


def test_a_turned_film_is_placed_and_named(drawn):
    films = first_frames(drawn[0], ("cam00", "cam01", "cam02"), 2)
    films["cam01"] = film_of("cam01", [np.rot90(p).copy() for p in films["cam01"].source.pictures])
    found = recover_cameras(films, [], None, OPTIONS)
    assert found.cameras["cam01"].status == "ok"
    assert [note for note in found.notes if "cam01 is turned by about" in note and "rotation flag" in note]


def test_a_short_gap_is_bridged_and_a_long_one_is_named(drawn):
    films, truth = draw_films(3, 10)
    blank = np.full((240, 320, 3), 90, np.uint8)
    short, long = (list(films[name].source.pictures) for name in ("cam01", "cam02"))
    short[4], long[3:7] = blank, [blank] * 4
    films |= {"cam01": film_of("cam01", short), "cam02": film_of("cam02", long, wanted=(1, 9))}
    found = recover_cameras(films, [], None, OPTIONS)
    assert found.cameras["cam01"].source_frames.tolist() == list(range(10))
    assert "cam01: the poses of frames 4 are interpolated" in found.notes
    assert errors_of(found, truth, ["cam00", "cam01"]).rotation_deg.max() < 0.5
    assert found.cameras["cam02"].status == "no pose could be found for frames 3-6"


def test_one_input_film_is_refused(drawn):
    films = {name: drawn[0][name] for name in ("cam00", "cam01")}
    with pytest.raises(InputError, match=r"at least 2 input cameras, got 1 \(cam00\)"):
        recover_cameras(films, ["cam01"], None, OPTIONS)


def test_films_of_different_places_are_refused_with_the_reasons(drawn):
    blank = film_of("cam01", [np.full((240, 320, 3), 90, np.uint8)] * 5)
    with pytest.raises(InputError, match="cam01: the picture is constant"):
        recover_cameras({"cam00": drawn[0]["cam00"], "cam01": blank}, [], None, OPTIONS)


def test_cameras_at_one_place_are_refused_or_named():
    films, _ = draw_films(1, 2, shake=0.0)
    pictures = films["cam00"].source.pictures
    same = {name: film_of(name, pictures) for name in ("cam00", "cam01", "cam02")}
    try:
        notes = " ".join(recover_cameras(same, [], None, OPTIONS).notes)
    except InputError as error:
        notes = str(error)
    assert "one place" in notes or "turned on the spot" in notes


def test_a_planar_wall_is_named():
    wall = [([-5, 3, 4], [10.0, 0, 0], [0, 0, -6.0])]
    films, _ = draw_films(3, 1, planes=wall)
    try:
        notes = " ".join(recover_cameras(films, [], None, OPTIONS).notes)
    except InputError as error:
        notes = str(error)
    assert "explained by one homography: the scene is a plane" in notes


def test_films_of_two_places_leave_out_the_smaller_group_by_name(drawn):
    elsewhere, _ = draw_films(2, 2, textures=[make_texture(512, seed) for seed in range(10, 15)])
    others = {f"far{i}": film_of(f"far{i}", f.source.pictures) for i, f in enumerate(elsewhere.values())}
    films = first_frames(drawn[0], ("cam00", "cam01", "cam02"), 2)
    found = recover_cameras({**others, **films}, [], None, OPTIONS)
    assert [n for n, film in found.cameras.items() if film.status == "ok"] == list(films)
    assert found.cameras["far0"].status.startswith(
        "the picture matches only far1, which do not connect to the other cameras"
    )
    assert (
        "the films fall into separate models: cam00, cam01, cam02 form the larger one, which is used; "
        "far0, far1 do not connect to it"
    ) in found.notes


def test_frames_are_narrowed_to_the_scene_by_the_sound():
    pts_s = np.arange(300) / 30
    clocks = Offsets("cam00", {"cam00": CameraClock(-4.0), "cam01": CameraClock(0, status="silent")}, 0.0)
    frames, wanted = select_frames("cam00", pts_s, clocks, None, 1.0, 0.5)
    assert (frames[0], frames[-1], wanted) == (105, 165, (120, 150))
    assert select_frames("cam01", pts_s, clocks, None, 1.0, 0.5)[0].tolist() == list(range(300))
    assert len(select_frames("cam00", pts_s, clocks, 100.0, 1.0, 0.5)[0]) == 0


def test_focal_start_and_scale_hint_words():
    assert focal_guess_px((3600, 2400), 50.0) == pytest.approx(5000, rel=1e-3)
    assert focal_guess_px((200, 100), None) == focal_guess_px((100, 200), 0.0)
    assert parse_scale_hint(["none"]) is None
    assert parse_scale_hint(["a", "b", "2.5"]) == ("a", "b", 2.5)
    for words in (["a", "b"], ["a", "a", "1"], ["a", "b", "-1"], ["a", "b", "c"]):
        with pytest.raises(InputError, match="two cameras and their distance"):
            parse_scale_hint(words)
