"""Rows of a scored camera that depend on where it stands, and on people in the inputs."""

import pytest

from fourd import io
from fourd.errors import InputError
from fourd.evaluate.__main__ import main
from tests.unit.test_evaluate import HELDOUT, NAMES, camera_command, make_estimates, make_scene, read_rows


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("places")
    make_scene(folder)
    make_estimates(folder)
    return folder


def test_people_that_are_asked_for_and_cannot_be_found_say_why(scene, tmp_path):
    command = ["people", "--view-files", str(scene / "views" / f"{HELDOUT}.json")]
    command += ["--cameras", str(scene / "cameras.json")]
    command += ["--films", *(f"{name}={scene / name}.json" for name in NAMES)]
    main([*command, "--humans", str(tmp_path), "--output", str(tmp_path / "people.npz")])
    main(
        [
            *camera_command(scene, tmp_path, labels=None, points=None, people=tmp_path / "people.npz"),
            "--humans",
            str(tmp_path),
        ]
    )
    rows = [row for row in read_rows(tmp_path / "cam01.csv") if row["method"] == "sfm_humans"]
    assert {row["note"].split(":")[0] for row in rows} == {f"no folder {tmp_path / 'pose'}"}
    with pytest.raises(InputError, match="expected camera cam03 in --films"):
        main([*command[:-1], "--humans", str(tmp_path), "--output", str(tmp_path / "people.npz")])


def test_a_view_from_beyond_the_inputs_has_its_own_region(scene, tmp_path):
    """cam00 stands at the end of the row, 20 degrees beyond the others: all that it sees of it is outside."""
    cameras = io.read_json(scene / "cameras.json")
    cameras |= {"inputs": list(NAMES[1:]), "heldout": ["cam00"]}
    io.write_json(tmp_path / "cameras.json", cameras)
    view = io.read_json(scene / "views" / "cam00.json") | {"role": "heldout"}
    io.write_json(tmp_path / "cam00.json", view)
    for name in ("foreground", "background"):
        archive = io.Archive(scene / f"{name}.npz")
        with io.ArchiveWriter(tmp_path / f"{name}.npz", {**archive.meta, "view": "cam00"}) as writer:
            for frame in archive.frames():
                writer.add_frame(frame, **archive.frame(frame))
        archive.close()
    files = {name: tmp_path / f"{name}.npz" for name in ("foreground", "background")}
    files |= {"view_file": tmp_path / "cam00.json", "cameras": tmp_path / "cameras.json"}
    main(camera_command(scene, tmp_path, labels=None, points=None, **files))
    rows = read_rows(tmp_path / "cam01.csv")
    own = [r for r in rows if r["region"] == "outside_hull" and r["metric"] == "psnr_db" and r["value"]]
    assert {row["method"] for row in own} >= {"ours", "paste", "background"}
    # Where no estimate has a depth nothing can be said.
    assert {row["num_pixels"] for row in own} == {str(64 * 96 - 8 * 96)}
