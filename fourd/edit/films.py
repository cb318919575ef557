"""The job that edits a chunk of one view: edit/{edit}/{view}/{chunk}/."""

import contextlib
import dataclasses
import logging
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.edit import compose, insert, shadows
from fourd.edit.compose import Canvas
from fourd.edit.instants import Instants
from fourd.edit.layers import LayeredPairs
from fourd.edit.moving import places_of
from fourd.edit.options import EditOptions
from fourd.edit.origin import find_origin
from fourd.edit.outline import widen
from fourd.edit.plate import FARTHEST, NEAREST, plate_of
from fourd.edit.spec import INSERT, Edit
from fourd.errors import InputError, explain_faults
from fourd.fuse.files import DisparityFiles, Progress
from fourd.fuse.options import FuseOptions
from fourd.fuse.view import FusedView, fuse_view
from fourd.image import undistort
from fourd.ingest import open_camera
from fourd.io import Archive, atomic_folder, read_image, write_csv, write_json, write_png
from fourd.render import BackgroundReader, RenderOptions, list_frames
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.views import View, ViewFrame, read_view

log = logging.getLogger(__name__)
COLUMNS = ("frame", "changed_share", "same_time", "other_time", "inferred", "inserted", "seconds")
_BACKGROUND = ("farthest_rgb", "farthest_valid", "median_rgb", "median_valid", "depth", "filled")
# A shadow's edge is lighter than what is told to be one, px.
_PENUMBRA_PX = 2
# What lies nearer than an inserted thing by this share of the depth hides it.
_SAME_DEPTH = 0.01
# Codes of the first channel of a provenance picture.
KINDS = {
    "untouched": compose.UNTOUCHED,
    "inserted": compose.INSERTED,
    "same_time": compose.SAME_TIME,
    "other_time": compose.OTHER_TIME,
    "inferred": compose.INFERRED,
}


@dataclasses.dataclass(frozen=True)
class Files:
    """What the job reads. rendered: folders of a trajectory's frames;  film: of a physical camera"""

    masks: Path
    view: Path
    cameras: Path
    films: Sequence[str]
    depths: Sequence[Path]
    disparity: Sequence[Path]
    background: Path
    models: Sequence[Path]
    rendered: Sequence[Path]
    film: Path | None
    mark_views: Sequence[Path] = ()


def run(
    edit: Edit,
    files: Files,
    frames: Sequence[int],
    options: EditOptions,
    fuse_options: FuseOptions,
    render_options: RenderOptions,
    output: Path,
) -> None:
    """Write the edited frames of a view, where their pixels came from, and a table.

    Raises InputError for a view that was left out of the calibration, or files that do not fit together.
    """
    scene, view = read_cameras(files.cameras), read_view(files.view)
    if view.name in scene.left_out or view.role == "left_out":
        raise InputError(
            f"view {view.name} was left out of the calibration "
            f"({scene.left_out.get(view.name, view.status)}), so it cannot be edited: choose another view"
        )
    progress = Progress("edited frame", len(frames), time.monotonic)
    with contextlib.ExitStack() as stack:
        editor = Editor(edit, files, scene, view, (options, fuse_options, render_options), stack)
        rows = []
        with atomic_folder(output) as folder:
            for frame in frames:
                start = time.monotonic()
                canvas = editor.edit_frame(frame)
                write_png(folder / f"{frame:06d}.png", canvas.picture())
                write_png(folder / "provenance" / f"{frame:06d}.png", canvas.provenance())
                rows.append(_describe(frame, canvas, time.monotonic() - start))
                progress.step(f"{100 * rows[-1]['changed_share']:.1f} % changed")
            legend = {"cameras": list(editor.instants.names), "frames": editor.times, **KINDS}
            write_json(folder / "provenance.json", legend)
            write_csv(folder / "edit.csv", COLUMNS, rows)


def _describe(frame: int, canvas: Canvas, seconds: float) -> dict[str, Any]:
    kind = canvas.kind
    shares = {key: float((kind == code).mean()) for key, code in KINDS.items() if code}
    return {"frame": frame, "changed_share": float((kind > 0).mean()), "seconds": round(seconds, 3), **shares}


class Editor:
    """Everything that the frames of one view share. times: scene frames that provenance counts"""

    def __init__(
        self,
        edit: Edit,
        files: Files,
        scene: SceneCameras,
        view: View,
        options: tuple[EditOptions, FuseOptions, RenderOptions],
        stack: contextlib.ExitStack,
    ) -> None:
        # Torch takes seconds to import; only this job needs it.
        from fourd.composition.infer import compose_frame, load_models

        self._edit, self._scene, self._view = edit, scene, view
        self._options, self._fuse, self._render = options
        self._masks = stack.enter_context(contextlib.closing(Archive(files.masks)))
        with explain_faults(f"masks of this workflow in {files.masks}"):
            self._side = float(self._masks.meta["voxel_side"])
            light = self._masks.meta["light"]
            self._light = None if light is None else np.array(light, np.float64)
        self.instants = stack.enter_context(
            contextlib.closing(Instants(scene, files.films, files.depths, self._options.num_times))
        )
        self._pairs = stack.enter_context(contextlib.closing(DisparityFiles(files.disparity, view.name)))
        archive = stack.enter_context(contextlib.closing(Archive(files.background)))
        self._background = BackgroundReader(archive, _BACKGROUND)
        self._models, self._compose_frame = load_models(list(files.models)), compose_frame
        self._rendered = list_frames(files.rendered) if files.rendered else {}
        self._film = stack.enter_context(contextlib.closing(open_camera(files.film))) if files.film else None
        self.times = self.instants.frames
        self._pictures: list[np.ndarray] = []
        self._place: insert.Place | None = None
        if edit.operation == INSERT and edit.pictures is not None:
            self._pictures = insert.read_pictures(edit.pictures)
            self._place = self._find_place(files)

    def _find_place(self, files: Files) -> insert.Place:
        from fourd.edit.masks import place_of_mark
        from fourd.edit.seeds import surface_of

        mark = self._edit.marks[0]
        views = {view.name: view for view in map(read_view, files.mark_views)}
        frame, camera = place_of_mark(mark, self._scene, views)
        depth = surface_of(self.instants.at(frame), camera)[0]
        return insert.place_in_box(mark.points, camera, depth, mark.describe())

    def _base(self, frame: int, entry: ViewFrame) -> np.ndarray:
        """(H, W, 3) uint8 picture that is edited."""
        if self._film is not None:
            physical = self._scene.tracks[self._view.name].at(entry.scene_frame)
            return undistort(self._film.read(entry.scene_frame), physical, entry.camera)[0]
        if frame not in self._rendered:
            raise InputError(
                f"expected rendered frame {frame} of {self._view.name}, got {len(self._rendered)} others: "
                "render the view again"
            )
        return read_image(self._rendered[frame])

    def _taken(self, scene_frame: int) -> tuple[dict[str, np.ndarray], tuple[np.ndarray, ...]]:
        """Masks of the cameras, and points of the thing, of what else moves and of what stands beside."""
        key = f"{scene_frame:06d}"
        masks = {name: self._masks[f"{key}/{name}"] > 0 for name in self._masks.meta["cameras"]}
        points = (self._masks[f"{key}/{kind}"].astype(np.float64) for kind in ("points", "others", "still"))
        return masks, tuple(points)

    def _fused(
        self,
        entry: ViewFrame,
        scene_frame: int,
        masks: Mapping[str, np.ndarray] | None,
        is_kept: bool = False,
    ) -> FusedView:
        """The view fused without, or only from, the marked samples; with `masks` None from all."""
        cameras, images = self.instants.pinholes(scene_frame)
        pairs: Any = self._pairs.at(scene_frame, self._fuse.memory_mb)
        if masks is not None:
            pairs = LayeredPairs(pairs, masks, cameras, is_kept)
        others = {name: image for name, image in images.items() if name != self._view.name}
        estimates = (
            ("consensus",) if masks is None or is_kept else ("consensus", "closest", "median", "farthest")
        )
        return fuse_view(entry.camera, pairs, others, cameras, self._fuse, estimates)

    def _static(self, entry: ViewFrame, background: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Colours, where they are known, and z, of what stands still in the view."""
        known = background["farthest_valid"] & ~background["filled"]
        if self._film is None or self._view.name not in self.instants.names:
            return background["farthest_rgb"], np.zeros_like(known), background["depth"]
        width, height = entry.camera.size
        depth = background["depth"][known]
        far = float(np.median(depth)) if depth.size else 1.0
        views = self.instants.still(self._view.name, entry.scene_frame)
        window = slice(0, height), slice(0, width)
        return plate_of(entry.camera, window, (NEAREST * far, FARTHEST * far), views)

    def edit_frame(self, frame: int) -> Canvas:
        """One output frame."""
        entry = self._view.at(frame)
        canvas = Canvas.of(self._base(frame, entry))
        if self._edit.operation == INSERT:
            self._insert(frame, entry, canvas)
            return canvas
        masks, things = self._taken(entry.scene_frame)
        background = self._background.read(frame)
        if not len(things[0]):
            return canvas
        fused = self._fused(entry, entry.scene_frame, masks)
        static = self._static(entry, background)
        plate = static if static[1].any() else (background["farthest_rgb"], background["farthest_valid"])
        mask = self._mask(canvas, entry, masks, things, plate)
        shadow = self._shadow(canvas, entry, things, plate, background) & ~mask
        opacity = np.maximum(self._soft(mask), self._soft(shadow))
        layer = self._layer(frame, entry, fused, static, background, opacity)
        if not static[1].any():
            # Nothing but other cameras at the same time shows the ground here, and they see the shadow.
            dark = self._shadow(layer, entry, things, plate, background) & (opacity > 0)
            shade = self._soft(widen(dark, _PENUMBRA_PX))
            layer.image = shadows.relight(layer.image, plate[0], shade)
            opacity = np.maximum(opacity, shade)
        canvas.lay(layer, opacity)
        return canvas

    def _soft(self, mask: np.ndarray) -> np.ndarray:
        return compose.soften(mask, self._options.grow_px, self._options.feather_px)

    def _mask(
        self, canvas: Canvas, entry: ViewFrame, masks: Mapping[str, np.ndarray],
        things: tuple[np.ndarray, ...], plate: tuple[np.ndarray, ...],
    ) -> np.ndarray:  # fmt: skip
        own = masks.get(self._view.name)
        if own is not None and own.shape == canvas.kind.shape:
            return own
        depth = self._fused(entry, entry.scene_frame, None).depths["consensus"]
        image = canvas.picture()
        return compose.mask_in_view(image, entry.camera, depth, things, self._side, plate[:2])  # type: ignore[arg-type]

    def _layer(
        self, frame: int, entry: ViewFrame, fused: FusedView, static: tuple[np.ndarray, ...],
        background: Mapping[str, np.ndarray], opacity: np.ndarray,
    ) -> Canvas:  # fmt: skip
        foreground = {f"{e}_rgb": rgb for e, rgb in fused.rgb.items()}
        foreground |= {f"{e}_valid": valid for e, valid in fused.valid.items()}
        composed, _ = self._compose_frame(self._models, frame, foreground, background, self._render)
        names = self.instants.names
        order = np.array([names.index(c) for c in fused.cameras] + [compose.NOBODY], np.uint8)
        source = order[np.minimum(fused.source, len(fused.cameras))]
        consensus = fused.depths["consensus"], fused.valid["consensus"], source
        static_depth = np.where(static[1], static[2], background["depth"])
        sampled = [time for time in self.instants.times if time != entry.scene_frame or self._film is None]
        sights = [
            (
                names.index(name),
                self.times.index(t),
                self.instants.camera(name, t),
                self.instants.depth(name, t),
            )
            for t in sampled
            for name in names
        ]
        origin = find_origin(entry.camera, static_depth, opacity > 0, sights)
        return compose.without_thing(composed, consensus, static, origin, self.times.index(entry.scene_frame))  # type: ignore[arg-type]

    def _shadow(
        self, canvas: Canvas, entry: ViewFrame, things: tuple[np.ndarray, ...],
        plate: tuple[np.ndarray, ...], background: Mapping[str, np.ndarray],
    ) -> np.ndarray:  # fmt: skip
        shadow = np.zeros(canvas.kind.shape, bool)
        if self._light is None:
            return shadow
        dark = shadows.find_dark(canvas.picture(), plate[0], plate[1]) & np.isfinite(background["depth"])
        places = places_of(entry.camera, background["depth"], dark)
        shadow[dark] = shadows.shadow_of(things[0], things[1], places, self._light, self._side)
        return shadow

    def _insert(self, frame: int, entry: ViewFrame, canvas: Canvas) -> None:
        """Put pictures, or the thing at another time, into the frame."""
        fused = self._fused(entry, entry.scene_frame, None)
        depth = np.where(
            fused.valid["consensus"], fused.depths["consensus"], self._background.read(frame)["depth"]
        )
        if self._place is not None:
            picture = self._pictures[frame % len(self._pictures)]
            rgb, opacity, plane = insert.draw_picture(picture, self._place, entry.camera, self._scene.up)
            layer = Canvas.of(rgb)
        else:
            then = entry.scene_frame + self._edit.shift_frames
            if then not in self.times:
                return
            thing = self._fused(entry, then, self._taken(then)[0], is_kept=True)
            layer = Canvas.of(thing.rgb["consensus"])
            opacity = self._soft(thing.valid["consensus"]) * thing.valid["consensus"]
            plane = np.where(thing.valid["consensus"], thing.depths["consensus"], np.inf)
            layer.time[:] = self.times.index(then)
        layer.kind[:] = compose.INSERTED
        with np.errstate(invalid="ignore"):
            hidden = depth < plane * (1 - _SAME_DEPTH)
        canvas.lay(layer, opacity * (1 - self._soft_edge(hidden)))

    def _soft_edge(self, mask: np.ndarray) -> np.ndarray:
        return compose.soften(mask, 0.0, self._options.feather_px)
