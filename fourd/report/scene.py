"""What was filmed, from where and when: cameras, clocks, pairs, and what was left out with its reason."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from fourd.io import Archive, read_csv, read_json
from fourd.report.current import Current
from fourd.report.numbers import finite, parse

MAX_MAP_POINTS = 1200
MAX_PATH_POINTS = 60
# Sparse points farther from the middle of the cameras than this many times their spread are not drawn.
MAP_REACH = 2.5


def collect_scene(results: Path) -> dict[str, Any]:
    """The parts `scene`, `cameras` and `clock` of the report. Raises InputError without sfm/cameras.json."""
    document = read_json(results / "sfm" / "cameras.json")
    films = _read_if_there(results / "sfm" / "film_cameras.json")
    offsets = _read_if_there(results / "align" / "offsets.json")
    colour = _read_if_there(results / "frames" / "colour.json")
    names = [*document["inputs"], *document["heldout"], *document["left_out"]]
    metres = films.get("metres_per_unit")
    scene = {
        "name": results.resolve().name,
        "fps": document["fps"],
        "num_frames": document["num_frames"],
        "duration_s": document["num_frames"] / document["fps"],
        "up": document["up"],
        "metres_per_unit": None if metres is None else metres * document["world"]["scale"],
    }
    return {
        "scene": scene,
        "cameras": [
            _describe_camera(results, name, document, films, offsets, colour) for name in sorted(names)
        ],
        "clock": {
            "reference": offsets.get("reference"),
            "notes": offsets.get("notes", []),
            "pairs": [
                {key: pair.get(key) for key in ("left", "right", "method", "score", "status")}
                | {"delay_s": finite(pair.get("delay_s")), "sigma_s": finite(pair.get("sigma_s"))}
                for pair in offsets.get("pairs", [])
            ],
        },
        "calibration_notes": films.get("notes", []),
    }


def _read_if_there(path: Path) -> dict[str, Any]:
    return read_json(path) if path.is_file() else {}


def _describe_camera(
    results: Path,
    name: str,
    document: Mapping[str, Any],
    films: Mapping[str, Any],
    offsets: Mapping[str, Any],
    colour: Mapping[str, Any],
) -> dict[str, Any]:
    aligned = _read_if_there(results / "align" / "cameras" / f"{name}.json")
    source = aligned.get("ingest") or _read_if_there(results / "ingest" / f"{name}.json")
    role = (
        "left out" if name in document["left_out"] else "held out" if name in document["heldout"] else "input"
    )
    entry = document["cameras"].get(name, {})
    film = films.get("cameras", {}).get(name, {})
    clock = offsets.get("cameras", {}).get(name, aligned)
    tone = colour.get("cameras", {}).get(name, {})
    return {
        "name": name,
        "role": role,
        "status": document["left_out"].get(name, "ok"),
        "source": source.get("source"),
        "size": source.get("size") or entry.get("size"),
        "fps": source.get("fps"),
        "num_source_frames": source.get("num_source_frames"),
        "device": " ".join(filter(None, [source.get("make"), source.get("model")])) or None,
        "flags": {kind: len(frames) for kind, frames in (source.get("flags") or {}).items() if frames},
        "offset_s": finite(clock.get("offset_s")),
        "rate_ppm": finite(clock.get("rate_ppm")),
        "sigma_s": finite(clock.get("sigma_s")),
        "clock_method": clock.get("method"),
        "clock_status": clock.get("status"),
        "largest_dt_s": max(map(abs, aligned.get("dt_s") or []), default=None),
        "reprojection_error_px": finite(film.get("reprojection_error_px")),
        "is_moving": len(entry.get("frames", [])) > 1,
        "depth_range_from": entry.get("depth_range_from"),
        "colour_status": tone.get("status"),
        "colour_sigma_levels": finite(tone.get("sigma_levels")),
    }


def collect_map(results: Path, views: Iterable[str]) -> dict[str, Any]:
    """The part `map`: everything seen from above, (x, y) in world units.

    views: names of the scene's views. y points where the input cameras look on average, so that the event
    lies in the upper half.
    """
    document = read_json(results / "sfm" / "cameras.json")
    up = np.asarray(document["up"], np.float64)
    poses = {name: _poses(entry["frames"]) for name, entry in document["cameras"].items()}
    looks = np.concatenate([forward for _, forward in poses.values()] or [np.zeros((1, 3))])
    ground = ground_axes(up, looks.mean(axis=0))
    cameras = []
    for name, (centers, forward) in poses.items():
        entry = document["cameras"][name]
        fov = 2 * np.degrees(np.arctan(entry["size"][0] / 2 / entry["frames"][0]["K"][0][0]))
        heading = forward[0] @ ground.T
        cameras.append(
            {
                "name": name,
                "role": "held out" if name in document["heldout"] else "input",
                "path": _thin(centers @ ground.T),
                "heading": heading.tolist(),
                "height": float(np.median(centers @ up)),
                "fov_deg": float(fov),
            }
        )
    trajectories = []
    for name in views:
        view = read_json(results / "views" / f"{name}.json")
        if view["role"] == "virtual" and view["frames"]:
            centers, _ = _poses(view["frames"])
            trajectories.append({"name": name, "path": _thin(centers @ ground.T)})
    all_centers = np.concatenate([centers for centers, _ in poses.values()] or [np.zeros((1, 3))])
    points = _points_near(results / "sfm" / "points.npz", all_centers)
    return {
        "cameras": cameras,
        "trajectories": trajectories,
        "points": np.round(points @ ground.T, 4).tolist(),
    }


def ground_axes(up: np.ndarray, look: np.ndarray) -> np.ndarray:
    """(2, 3) right and ahead on the ground, seen from above; any direction if `look` is straight up or 0."""
    up = up / np.linalg.norm(up)
    ahead = look - (look @ up) * up
    if np.linalg.norm(ahead) < 0.05:
        ahead = np.eye(3)[np.argmin(np.abs(up))]
        ahead = ahead - (ahead @ up) * up
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(ahead, up), ahead])


def _poses(frames: list[Mapping[str, Any]]) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) centres and (N, 3) viewing directions in the world."""
    rotations = np.array([frame["R"] for frame in frames], np.float64)
    translations = np.array([frame["t"] for frame in frames], np.float64)
    return -np.einsum("nji,nj->ni", rotations, translations), rotations[:, 2]


def _thin(path: np.ndarray) -> list[list[float]]:
    step = max(1, -(-len(path) // MAX_PATH_POINTS))
    chosen = np.concatenate([path[::step], path[-1:]]) if len(path) > 1 else path
    return np.round(chosen, 4).tolist()


def _points_near(path: Path, centers: np.ndarray) -> np.ndarray:
    if not path.is_file():
        return np.zeros((0, 3))
    with closing(Archive(path)) as archive:
        points = archive["points"]
    middle = centers.mean(axis=0)
    spread = max(float(np.linalg.norm(centers - middle, axis=1).max()), 1e-9)
    points = points[np.linalg.norm(points - middle, axis=1) < MAP_REACH * spread]
    return points[:: max(1, -(-len(points) // MAX_MAP_POINTS))]


def collect_pairs(results: Path, current: Current) -> list[dict[str, Any]]:
    """The part `pairs`: how each pair of input cameras is matched, or why it is not."""
    pairs = []
    for path in sorted((results / "rectification").glob("*.npz")):
        if not current.has_pair(path.stem):
            continue
        with closing(Archive(path)) as archive:
            meta = archive.meta
        guard = meta.get("guard", {})
        pairs.append(
            {
                "pair": path.stem,
                "left": meta["left"],
                "right": meta["right"],
                "status": meta["status"],
                "kind": meta.get("kind"),
                "obstacle": meta.get("obstacle"),
                "angle_deg": finite(meta.get("angle_deg")),
                "baseline": finite((guard.get("baseline") or [None])[0]),
                "overlap": finite((guard.get("overlap") or [None])[0]),
                "depth_error": finite((guard.get("depth_error") or [None])[-1]),
            }
        )
    return pairs


def collect_renders(results: Path, current: Current) -> list[dict[str, Any]]:
    """The part `renders`: per view and level the share of blank pixels and why coarser levels help or not."""
    renders = []
    for view in current.views:
        tables = [path / "holes.csv" for path in current.chunks_in(results / "render" / view, view)]
        rows = [row for path in tables if path.is_file() for row in read_csv(path)]
        for level in sorted({row["level"] for row in rows}):
            own = [row for row in rows if row["level"] == level]
            holes, filled = (
                [parse(row[key]) or 0.0 for row in own] for key in ("hole_share", "filled_share")
            )
            renders.append(
                {
                    "view": view,
                    "level": level,
                    "num_frames": len(own),
                    "mean_hole_share": sum(holes) / len(own),
                    "max_hole_share": max(holes),
                    "mean_filled_share": sum(filled) / len(own),
                    "reasons": dict(Counter(row["reason"] for row in own)),
                }
            )
    return renders


def collect_left_out(
    results: Path,
    current: Current,
    pairs: Sequence[Mapping[str, Any]],
    rows: Sequence[Mapping[str, Any]],
) -> list[dict[str, str]]:
    """The part `left_out`: cameras, pairs, views, frames, stages and methods without result, with the reason.

    pairs, rows: of the parts `pairs` and `scores`
    """
    found = [*_left_out(results, current, pairs), *_empty_methods(rows)]
    return [{"kind": kind, "name": name, "reason": reason} for kind, name, reason in found]


def _empty_methods(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, str, str]]:
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        if not any(row["num_values"] + row["num_infinite"] for row in own):
            yield "method", method, own[0]["note"] or "it has no picture in any frame"


def _left_out(
    results: Path, current: Current, pairs: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, str, str]]:
    cameras = read_json(results / "sfm" / "cameras.json")
    for name, reason in cameras["left_out"].items():
        yield "camera", name, reason
    for name in current.views:
        status = read_json(results / "views" / f"{name}.json")["status"]
        if status != "ok" and name not in cameras["left_out"]:
            yield "view", name, status
    for pair in pairs:
        if pair["status"] != "ok":
            yield "pair", pair["pair"], pair["status"]
    folder = results / "foreground"
    paths = [path for name in current.views for path in current.chunks_in(folder / name, name)]
    for path in paths:
        with closing(Archive(path)) as archive:
            for frame, status in archive.meta.get("frame_status", {}).items():
                if status != "ok":
                    yield "frame", f"{path.parent.name}, {int(frame)}", status
    need = results / "silhouettes" / "need.json"
    if need.is_file() and read_json(need)["status"] != "ok":
        yield "stage", "silhouettes and visual hull", read_json(need)["status"]


def collect_warnings(document: Mapping[str, Any]) -> list[str]:
    """Sentences about what may be worse than it looks, from the other parts of the report."""
    warnings = [*document["clock"]["notes"], *document["calibration_notes"]]
    frame_s = 1 / document["scene"]["fps"]
    for camera in document["cameras"]:
        name = camera["name"]
        warnings += [
            f"{name}: {count} frames of the film are {kind}" for kind, count in camera["flags"].items()
        ]
        if camera["sigma_s"] is not None and camera["sigma_s"] > frame_s / 2:
            warnings.append(
                f"{name}: its clock is known to {camera['sigma_s'] * 1e3:.0f} ms, over half a frame"
            )
        if (camera["reprojection_error_px"] or 0) > 1:
            warnings.append(
                f"{name}: static points miss by {camera['reprojection_error_px']:.2f} px, more than 1"
            )
        if camera["colour_status"] not in (None, "ok"):
            warnings.append(f"{name}: colours are left as filmed: {camera['colour_status']}")
    return warnings
