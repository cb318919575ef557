"""A camera's pictures as an ideal pinhole takes them, in time and in colour with the others."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.regions import StillPicture, find_dynamic_pixels
from fourd.export.event import MOVING, OUTSIDE, STILL, distance_of, held_pinhole, own_pinhole
from fourd.image import undistort
from fourd.ingest import open_camera
from fourd.io import atomic_folder, write_json, write_png
from fourd.sfm.cameras import SceneCameras
from fourd.video import encode_video

# Frames that the still picture is the median of.
NUM_STILL = 9
# As shares of `distance_of`: what is nearer and farther shifts by less than a pixel or two.
STILL_DEPTHS = (0.75, 1.5)
# A mask that lets something moving through does more harm than one that covers too much.
MASK_OPTIONS = EvaluateOptions(dynamic_tolerance_px=1)


def warp_by_depth(image: np.ndarray, camera: Camera, target: Camera, depth: float) -> np.ndarray:
    """A picture as another camera would take it if all it shows were at one depth of that camera.

    image: (H, W, 3) uint8 taken by `camera`, lens included;  depth: z in `target`, world units
    Returns (h, w, 3) uint8, edges repeated where `camera` did not look.
    """
    if not camera.is_distorted:
        # All points lie in one plane of the target, so a matrix says where they are.
        turn = camera.R @ target.R.T
        shift = camera.t - turn @ target.t
        plane = camera.K @ (turn + np.outer(shift, [0, 0, 1 / depth])) @ np.linalg.inv(target.K)
        how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return np.asarray(
            cv2.warpPerspective(image, plane, target.size, flags=how, borderMode=cv2.BORDER_REPLICATE)
        )
    width, height = target.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    points = target.unproject(grid, np.full((height, width), depth))
    pixels = np.nan_to_num(camera.project(points)[0], nan=-1.0).astype(np.float32)
    return np.asarray(
        cv2.remap(image, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    )


def run_pictures(film: Path, scene: SceneCameras, size: tuple[int, int] | None, output: Path) -> None:
    """Write a folder of `000012.png`, `masks/000012.png` and `held.mp4` of one camera.

    A mask is 0 where the lens or the size leave a blank, 128 where nothing moves, 255 where something
    does (what the median over time does not explain). held.mp4 is the film from one place:
    `held_pinhole`, exact where nothing is nearer or farther than `distance_of`.
    Of a camera that is left out the folder holds left_out.json with the reason.
    Raises InputError if the film cannot be read.
    """
    with open_camera(film) as reader:
        if reader.camera in scene.left_out:
            with atomic_folder(output) as folder:
                write_json(folder / "left_out.json", {"status": scene.left_out[reader.camera]})
            return
        name, track = reader.camera, scene.tracks[reader.camera]
        held, depth = held_pinhole(scene, name, size), distance_of(track)
        cameras = [own_pinhole(scene, name, frame, size) for frame in range(scene.num_frames)]
        chosen = np.unique(np.linspace(0, scene.num_frames - 1, NUM_STILL).round().astype(int))
        middle = cameras[int(chosen[len(chosen) // 2])]
        # What a steady surface shows, for surfaces at two depths: none that shakes is taken for motion.
        stills = []
        for near in STILL_DEPTHS[: 1 if track.is_static else None]:
            at = near * depth
            steady = [warp_by_depth(reader.read(int(f)), track.at(int(f)), middle, at) for f in chosen]
            still, known = StillPicture([(picture, middle) for picture in steady]).seen_from(middle)
            stills.append((at, np.dstack([still, 255 * known.astype(np.uint8)])))

        def pictures() -> Iterator[np.ndarray]:
            for frame, pinhole in enumerate(cameras):
                image, camera = reader.read(frame), track.at(frame)
                picture, inside = undistort(image, camera, pinhole)
                write_png(folder / f"{frame:06d}.png", picture)
                here = [warp_by_depth(still, middle, pinhole, at) for at, still in stills]
                explained = [(still[..., :3], still[..., 3] > 127) for still in here]
                moves = find_dynamic_pixels(picture, explained, MASK_OPTIONS)
                mask = np.where(inside, np.where(moves, MOVING, STILL), OUTSIDE).astype(np.uint8)
                write_png(folder / "masks" / f"{frame:06d}.png", mask)
                yield warp_by_depth(image, camera, held, depth)

        with atomic_folder(output) as folder:
            encode_video(folder / "held.mp4", pictures(), scene.fps)
