"""The embedded demo event: a small square, two walkers, a ball, and people who film it with phones.

Pure seeded code, exact truth: cameras, depth, labels (0 static, 1 first figure, 2 second figure,
3 ball), clocks. World: metres, x right, y away from the cameras, z up. All motion is a function of
`time_s`, so that any camera can film at any rate and between frames.
"""

from fourd.demo.cameras import camera_at, camera_tracks, clip_times, middle_time, orbit_cameras
from fourd.demo.options import DemoOptions, camera_names
from fourd.demo.render import FrozenScene, label_numbers

STAGE_VERSION = 2

__all__ = [
    "STAGE_VERSION",
    "DemoOptions",
    "FrozenScene",
    "camera_at",
    "camera_names",
    "camera_tracks",
    "clip_times",
    "label_numbers",
    "middle_time",
    "orbit_cameras",
]
