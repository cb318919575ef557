"""Edit files and marks: what is read, and a sentence for whatever cannot be used."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from fourd.edit.__main__ import main
from fourd.edit.carry import Found
from fourd.edit.mark import check_conflicts, draw_mark, read_mask
from fourd.edit.masks import check_marked, without_specks
from fourd.edit.spec import Mark, load_edits, read_edit
from fourd.errors import InputError

BOX = {"view": "cam01", "frame": 2, "box": [10, 5, 30, 40]}
VIEWS = {"cam01": {0: 0}, "hold_view": {i: i for i in range(6)}}


def write_edit(folder: Path, name: str = "gone", **changes: object) -> Path:
    document = {"scene": "demo", "operation": "remove", "views": ["cam01"], "marks": [BOX], **changes}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_edit_is_read(tmp_path: Path) -> None:
    edit = read_edit(write_edit(tmp_path, operation="see_behind", order=2, views=["cam01", "hold_view"]))
    assert (edit.name, edit.operation, edit.order, edit.views) == (
        "gone",
        "see_behind",
        2,
        ("cam01", "hold_view"),
    )
    assert edit.marks == (Mark("cam01", 2, "box", ((10.0, 5.0), (30.0, 40.0))),)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"operation": "erase"}, "operation is 'erase', expected one of"),
        ({"marks": []}, "marks is .*, expected at least 1 entries|should be non-empty"),
        ({"colour": 1}, "unknown key 'colour'"),
        ({"order": 2}, "order 2 belongs to see_behind"),
        (
            {"marks": [BOX | {"polygon": [[0, 0], [1, 1], [2, 0]]}]},
            "expected one of box.*got box and polygon",
        ),
        ({"marks": [{"view": "cam01", "frame": 2}]}, "got none"),
        ({"marks": [BOX | {"box": [30, 5, 10, 40]}]}, "left < right and top < bottom"),
        ({"marks": [BOX | {"box": [float("nan"), 5, 10, 40]}]}, "NaN or infinity"),
        ({"marks": [BOX | {"frame": -1}]}, "marks.0.frame is -1, expected at least 0"),
        ({"marks": [BOX | {"is_part": False}]}, "expected a mark of the thing"),
        ({"operation": "insert"}, "expected `insert:` with the operation insert"),
        ({"operation": "insert", "insert": {"shift_frames": 0}}, "shift_frames other than 0"),
        ({"marks": [{"view": "cam01", "frame": 0, "mask": "nowhere.png"}]}, "expected a file at nowhere.png"),
        (
            {"marks": [{"view": "cam01", "frame": 0, "mask": "{scene.__class__}.png"}]},
            "marks.0.mask is '{scene.__class__}.png'",
        ),
        (
            {"operation": "insert", "insert": {"pictures": "cat{view}.png"}},
            "insert.pictures is 'cat{view}.png'",
        ),
        (
            {"operation": "insert", "insert": {"pictures": "<results>/cat.png"}},
            "insert.pictures is '<results>",
        ),
    ],
)
def test_faults_of_an_edit_are_sentences(tmp_path: Path, changes: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_edit(write_edit(tmp_path, **changes))


def test_a_name_that_is_no_name_of_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="rename the file"):
        read_edit(write_edit(tmp_path, name="Gone 1"))


def test_an_edit_that_is_too_long_is_refused_before_it_is_parsed(tmp_path: Path) -> None:
    path = write_edit(tmp_path)
    path.write_text("#" * 2_100_000)
    with pytest.raises(InputError, match="give a mask as a PNG"):
        read_edit(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"views": ["cam09"]}, "view 'cam09' is neither a camera"),
        ({"marks": [BOX | {"view": "cam07"}]}, "view 'cam07' is neither"),
        ({"marks": [BOX | {"frame": 6}]}, "frame 6 of cam01 lies outside its frames 0 to 5"),
    ],
)
def test_views_and_frames_are_checked_against_the_scene(tmp_path: Path, changes: dict, message: str) -> None:
    write_edit(tmp_path, **changes)
    with pytest.raises(InputError, match=message):
        load_edits("demo", ["cam00", "cam01"], 6, VIEWS, tmp_path)


def test_edits_of_other_scenes_are_left_alone(tmp_path: Path) -> None:
    write_edit(tmp_path, scene="other", views=["nowhere"])
    assert load_edits("demo", ["cam01"], 6, VIEWS, tmp_path) == {}


def test_box_polygon_and_scribble_are_drawn() -> None:
    box = draw_mark(Mark("c", 0, "box", ((2.0, 3.0), (5.0, 8.0))), (20, 10))
    assert box.sum() == 4 * 6 and box[3, 2] and box[8, 5]
    polygon = draw_mark(Mark("c", 0, "polygon", ((2.0, 3.0), (5.0, 3.0), (5.0, 8.0), (2.0, 8.0))), (20, 10))
    assert (polygon == box).all()
    stroke = draw_mark(Mark("c", 0, "scribble", ((4.0, 5.0), (14.0, 5.0))), (20, 10))
    assert stroke[5, 4:15].all() and not stroke[0].any()


@pytest.mark.parametrize(
    "points", [((-9.0, 1.0), (-2.0, 4.0)), ((30.0, 1.0), (40.0, 4.0)), ((1e300, 1.0), (1e301, 4.0))]
)
def test_a_mark_outside_the_picture_is_refused(points: tuple) -> None:
    with pytest.raises(InputError, match="lies outside the picture of 20 x 10 px"):
        draw_mark(Mark("c", 3, "box", points), (20, 10))


def test_marks_that_contradict_each_other_are_refused() -> None:
    marks = [
        Mark("c", 0, "box", ((1.0, 1.0), (6.0, 6.0))),
        Mark("c", 0, "box", ((5.0, 5.0), (8.0, 8.0)), is_part=False),
    ]
    masks = [draw_mark(mark, (20, 10)) for mark in marks]
    with pytest.raises(InputError, match="contradict each other on 4 px"):
        check_conflicts(marks, masks)
    check_conflicts([marks[0], Mark("d", 0, "box", marks[1].points, is_part=False)], masks)


def test_a_mark_of_which_nothing_is_left_is_refused() -> None:
    nothing, something = np.zeros((4, 6), bool), np.eye(4, 6, dtype=bool)
    with pytest.raises(InputError, match="the box on frame 2 of cam01: .* mark the thing closer"):
        check_marked(Mark("cam01", 2, "box"), {"cam00": something, "cam01": nothing})
    check_marked(Mark("cam01", 2, "box"), {"cam00": nothing, "cam01": something})
    # A film of a trajectory has no mask of its own.
    check_marked(Mark("hold_view", 2, "box"), {"cam00": nothing, "cam01": something})
    with pytest.raises(InputError, match="frame 2 of hold_view"):
        check_marked(Mark("hold_view", 2, "box"), {"cam00": nothing, "cam01": nothing})


def test_voxels_that_no_picture_shows_are_noise() -> None:
    def found(mask: np.ndarray) -> Found:
        return Found({"cam00": mask}, {}, np.ones((3, 3)), np.ones((5, 3)), np.ones((7, 3)))

    nothing = without_specks(found(np.zeros((4, 6), bool)))
    assert (len(nothing.points), len(nothing.others), len(nothing.still)) == (0, 5, 7)
    assert len(without_specks(found(np.eye(4, 6, dtype=bool))).points) == 3


def png(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def test_masks_are_read_whatever_their_channels(tmp_path: Path) -> None:
    wanted = np.zeros((10, 20), bool)
    wanted[2:5, 3:9] = True
    grey = png(tmp_path / "grey.png", wanted.astype(np.uint8))
    colour = png(tmp_path / "colour.png", np.repeat(255 * wanted[..., None].astype(np.uint8), 3, axis=2))
    alpha = np.full((10, 20, 4), 255, np.uint8)
    alpha[..., 3] = 255 * wanted
    for path in (grey, colour, png(tmp_path / "alpha.png", alpha)):
        assert (read_mask(path, (20, 10)) == wanted).all()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def test_hostile_masks_are_refused_by_their_header(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.png"
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    bomb.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(10_000)))
    )
    with pytest.raises(InputError, match="got 60000 x 60000 px"):
        read_mask(bomb, (20, 10))
    for name, data, message in (
        ("text.png", b"not a picture", "save the mask as PNG"),
        (
            "cut.png",
            b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 20, 10, 8, 0, 0, 0, 0)),
            "decoded",
        ),
        ("large.png", bytes(10**6), "got a file of 1000000 bytes"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=message):
            read_mask(tmp_path / name, (20, 10))


def test_a_mask_of_another_size_or_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="got 30 x 10 px"):
        read_mask(png(tmp_path / "wide.png", np.ones((10, 30), np.uint8)), (20, 10))
    with pytest.raises(InputError, match="nothing is marked"):
        read_mask(png(tmp_path / "black.png", np.zeros((10, 20), np.uint8)), (20, 10))


def test_command_writes_an_edit_that_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "behind.yaml"
    main(
        [
            "mark",
            "cam04",
            "12",
            "--polygon",
            "1",
            "2",
            "9",
            "2",
            "9",
            "8",
            "--operation",
            "see_behind",
            "--order",
            "2",
        ]
        + ["--views", "cam04", "hold_view", "--output", str(path)]
    )
    edit = read_edit(path)
    assert edit.marks == (Mark("cam04", 12, "polygon", ((1.0, 2.0), (9.0, 2.0), (9.0, 8.0))),)
    assert (edit.operation, edit.order, edit.views) == ("see_behind", 2, ("cam04", "hold_view"))


def test_command_refuses_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    with pytest.raises(InputError, match="left < right"):
        main(["mark", "cam04", "12", "--box", "9", "2", "1", "8", "--views", "cam04", "--output", str(path)])
    assert not path.exists()
    with pytest.raises(InputError, match="pairs x y"):
        main(["mark", "cam04", "12", "--polygon", "9", "2", "1", "--views", "cam04", "--output", str(path)])
    with pytest.raises(InputError, match="one of --box"):
        main(["mark", "cam04", "12", "--views", "cam04", "--output", str(path)])


def test_command_leaves_other_edits_alone(tmp_path: Path) -> None:
    path = tmp_path / "gone.yaml"
    command = ["mark", "cam04", "12", "--views", "cam04", "--output", str(path), "--box"]
    main([*command, "1", "2", "9", "8"])
    text = "# Mine.\n" + path.read_text()
    path.write_text(text)
    main([*command, "1", "2", "9", "8"])
    for corners, message in (
        (("1", "2", "9", "9"), "says something else"),
        (("9", "2", "1", "8"), "left < right"),
    ):
        with pytest.raises(InputError, match=message):
            main([*command, *corners])
    assert path.read_text() == text
