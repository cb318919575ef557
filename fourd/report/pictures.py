"""Small pictures of every stage for chosen frames of chosen views."""

import base64
import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.image import resize_area, undistort
from fourd.ingest import open_camera
from fourd.io import Archive, read_image
from fourd.render import BackgroundReader, list_frames
from fourd.report import ReportOptions
from fourd.report.current import Current
from fourd.report.scores import Scores, ranked_frames
from fourd.sfm import SceneCameras, read_cameras
from fourd.stereo.files import decode_disparity
from fourd.views import View, ViewFrame, read_view

BLANK = 205
WEBP_QUALITY = 82
ESTIMATES = ("consensus", "closest", "median", "farthest")


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """(H, W, 3) uint8 and one plain sentence; no image where it is not there, and then why."""

    title: str
    caption: str
    image: np.ndarray | None


@dataclasses.dataclass(frozen=True, eq=False)
class FrameShow:
    """All pictures of one output frame. truth is None for a place where no camera was.

    why: how the frame was chosen
    """

    view: str
    frame: int
    scene_frame: int
    why: str
    truth: np.ndarray | None
    rendered: np.ndarray | None
    pictures: tuple[Picture, ...]


def data_uri(image: np.ndarray, max_width: int) -> str:
    """An image as text for a page: WebP, at most `max_width` px wide, never enlarged."""
    height, width = image.shape[:2]
    if width > max_width:
        image = resize_area(image, (max_width, max(1, round(height * max_width / width))))
    bgr = image[:, :, ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".webp", np.ascontiguousarray(bgr), [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
    if not done:
        raise ValueError(f"cannot encode an array of shape {image.shape} as WebP")
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def choose_views(scene: SceneCameras, rendered: Iterable[str], max_views: int) -> list[str]:
    """Held-out cameras first, in the scene's order, then films by name; those that were rendered."""
    there = sorted(rendered)
    heldout = [name for name in scene.heldout if name in there]
    return (heldout + [name for name in there if name not in heldout])[:max_views]


def choose_frames(view: View, scores: Scores | None, max_frames: int) -> list[tuple[int, str]]:
    """(frame, why): worst, best and those between by our score; evenly spread where nothing is scored."""
    frames = [entry.frame for entry in view.frames]
    ranked = [pair for pair in (ranked_frames(scores, view.name) if scores else []) if pair[0] in frames]
    count = min(max_frames, len(ranked) or len(frames))
    if not ranked:
        return [(frames[(2 * i + 1) * len(frames) // (2 * count)], "evenly spread") for i in range(count)]
    if count == 1:
        return [(ranked[len(ranked) // 2][0], "the middle one by score")]
    places = [round(i * (len(ranked) - 1) / (count - 1)) for i in range(count)]
    words = {0: "the worst by score", len(ranked) - 1: "the best by score"}
    return [(ranked[i][0], words.get(i, f"number {i + 1} of {len(ranked)} from the worst")) for i in places]


def collect_pictures(
    results: Path, current: Current, scores: Scores | None, options: ReportOptions
) -> list[FrameShow]:
    """Pictures of the chosen frames; a file that is gone leaves a place with its reason."""
    scene = read_cameras(results / "sfm" / "cameras.json")
    rendered = [name for name in current.views if (results / "render" / name).is_dir()]
    shows = []
    for name in choose_views(scene, rendered, options.max_views):
        view = read_view(results / "views" / f"{name}.json")
        if not view.frames:
            continue
        images = list_frames(current.chunks_in(results / "render" / name, name))
        for frame, why in choose_frames(view, scores, options.max_frames):
            rendering = read_image(images[frame]) if frame in images else None
            shows.append(_show_frame(results, current, scene, view, view.at(frame), why, rendering, options))
    return shows


def _show_frame(
    results: Path,
    current: Current,
    scene: SceneCameras,
    view: View,
    entry: ViewFrame,
    why: str,
    rendered: np.ndarray | None,
    options: ReportOptions,
) -> FrameShow:
    truth, pictures = None, []
    if view.name in scene.heldout:
        truth, reason = _filmed(
            results, scene, view.name, entry.scene_frame, entry.camera, is_compensated=False
        )
        if truth is None:
            pictures.append(Picture("truth", reason, None))
    pictures += _of_stereo(results, current, scene, view, entry)
    pictures += _of_foreground(results, current, view.name, entry.frame)
    pictures += _of_background(results, current, view.name, entry.frame)
    if rendered is None:
        pictures.append(Picture("render", "this frame has not been rendered", None))
    else:
        pictures.append(Picture("render", "what the network makes of all of these", rendered))
    if truth is not None and rendered is not None and truth.shape == rendered.shape:
        difference = np.abs(truth.astype(np.int16) - rendered) * options.error_gain
        error = np.minimum(difference, 255).astype(np.uint8)
        caption = f"difference from the truth, times {options.error_gain:g}; black is right"
        pictures.append(Picture("error", caption, error))
    return FrameShow(view.name, entry.frame, entry.scene_frame, why, truth, rendered, tuple(pictures))


def _filmed(
    results: Path, scene: SceneCameras, name: str, frame: int, target: Camera | None, is_compensated: bool
) -> tuple[np.ndarray | None, str]:
    """(H, W, 3) uint8 that a camera filmed, as `target` sees it if given; or None and the reason."""
    try:
        with closing(open_camera(results / "frames" / "cameras" / f"{name}.npz")) as reader:
            image = reader.read(frame, is_compensated=is_compensated)
    except InputError as error:
        return None, str(error)
    if target is not None:
        image = undistort(image, scene.tracks[name].at(frame), target)[0]
    return image, ""


def _archive_with(paths: Sequence[Path], frame: int) -> Archive | None:
    """The chunk that has a frame; the caller closes it."""
    for path in paths:
        first, last = map(int, path.stem.split("-"))
        if first <= frame <= last:
            return Archive(path)
    return None


def _gone(titles: Sequence[str], what: str) -> list[Picture]:
    reason = f"{what} was removed after its last use to save disk space, or has not been made"
    return [Picture(title, reason, None) for title in titles]


def nearest_pair(pairs: Iterable[str], centers: Mapping[str, np.ndarray], center: np.ndarray) -> str | None:
    """The pair whose two cameras are nearest to a place, by summed distance; None without pairs."""
    distance = {
        pair: sum(float(np.linalg.norm(centers[name] - center)) for name in pair.split("-")) for pair in pairs
    }
    return min(sorted(distance), key=lambda pair: distance[pair], default=None)


def _of_stereo(
    results: Path, current: Current, scene: SceneCameras, view: View, entry: ViewFrame
) -> list[Picture]:
    frame = entry.scene_frame
    found = {}
    for folder in sorted((results / "disparity").glob("*")):
        if not current.has_pair(folder.name) or view.name in folder.name.split("-"):
            continue
        paths = [p for p in current.chunks_in(folder) if int(p.stem[:6]) <= frame <= int(p.stem[-6:])]
        if paths:
            with closing(Archive(paths[0])) as archive:
                if archive.meta["status"] == "ok":
                    found[folder.name] = paths[0]
    centers = {name: track.at(frame).center for name, track in scene.tracks.items()}
    pair = nearest_pair(found, centers, entry.camera.center)
    if pair is None:
        return _gone(("input", "disparity"), "the disparity of this moment")
    left = pair.split("-")[0]
    image, reason = _filmed(results, scene, left, frame, None, is_compensated=True)
    with closing(Archive(found[pair])) as archive:
        disparity = decode_disparity(archive[f"{frame:06d}/left_disparity"])
    caption = f"of the pair {pair}: bright is near, grey is where the two pictures do not agree"
    return [
        Picture("input", reason or f"what {left} filmed, one of the nearest cameras", image),
        Picture("disparity", caption, colour_map(disparity)),
    ]


def colour_map(values: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 of (H, W) float; 2 % at both ends are cut off, grey where not finite."""
    known = np.isfinite(values)
    if not known.any():
        return np.full((*values.shape, 3), BLANK, np.uint8)
    low, high = np.percentile(values[known], (2, 98))
    levels = np.where(known, (values - low) / max(float(high - low), 1e-9), 0)
    picture = cv2.applyColorMap((np.clip(levels, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    picture = np.ascontiguousarray(picture[:, :, ::-1])
    picture[~known] = BLANK
    return picture


def _masked(image: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid[..., None], image, np.uint8(BLANK))


def _of_foreground(results: Path, current: Current, view: str, frame: int) -> list[Picture]:
    archive = _archive_with(current.chunks_in(results / "foreground" / view, view), frame)
    if archive is None:
        return _gone(ESTIMATES, "the foreground of this moment")
    captions = {
        "consensus": "the nearest surface that enough pairs agree on; grey where none do",
        "closest": "the nearest surface that any pair sees",
        "median": "the middle of all that the pairs see",
        "farthest": "the farthest surface that any pair sees",
    }
    pictures = []
    with closing(archive):
        for name in ESTIMATES:
            if f"{frame:06d}/{name}_rgb" in archive:
                image = _masked(archive[f"{frame:06d}/{name}_rgb"], archive[f"{frame:06d}/{name}_valid"])
                pictures.append(Picture(name, captions[name], image))
        if f"{frame:06d}/depth" in archive:
            with np.errstate(divide="ignore"):
                nearness = 1 / archive[f"{frame:06d}/depth"]
            pictures.append(Picture("depth", "of the consensus: bright is near", colour_map(nearness)))
    return pictures


def _of_background(results: Path, current: Current, view: str, frame: int) -> list[Picture]:
    archive = _archive_with(current.chunks_in(results / "background" / view, view), frame)
    if archive is None:
        return _gone(("background",), "the background of this view")
    with closing(archive):
        reader = BackgroundReader(archive, ("farthest_rgb", "farthest_valid"))
        if frame not in reader.frames():
            return [Picture("background", "this frame has none", None)]
        arrays = reader.read(frame)
    image = _masked(arrays["farthest_rgb"], arrays["farthest_valid"])
    return [Picture("background", "what stands still, voted over time; grey where nobody saw it", image)]
