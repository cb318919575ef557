"""A scene on paper for the tests of the plan: three cameras on an arc, a fourth too far away."""

import itertools
from collections.abc import Mapping

from fourd.config import CameraSource, Scene, load_config, view_frames
from fourd.plan.outline import describe_scene
from fourd.plan.work import PairFacts, Survey

CAMERAS: tuple[str, ...] = ("cam00", "cam01", "cam02", "cam03")
PAIRS = tuple(f"{left}-{right}" for left, right in itertools.combinations(CAMERAS, 2))
ANGLES = (12.0, 25.0, 70.0, 14.0, 60.0, 45.0)
TOO_WIDE = "the cameras see the scene too far apart"


def make_scene(num_frames: int = 120, size: tuple[int, int] = (480, 270), **changes: object) -> Scene:
    """Four inputs and one held-out camera; clock and cameras are to be found unless `changes` gives them."""
    facts: dict = {
        "name": "event",
        "fps": 30.0,
        "num_frames": num_frames,
        "start_s": None,
        "clock_is_given": False,
        "size": size,
        "cameras": {name: CameraSource(f"{name}.mp4", None, name) for name in (*CAMERAS, "cam04")},
        "heldout": ("cam04",),
        "calibration": (),
        "calibration_format": "fourd",
        "scale_hint": None,
        "depth_range": None,
        "labels": None,
    }
    return Scene(**{**facts, **changes})


def make_outline(scene: Scene | None = None, **settings: object) -> dict:
    """What the jobs of a scene follow from; `settings` as in the configuration."""
    scene = scene or make_scene()
    config = load_config(settings, {}, scene.name)
    return describe_scene(scene, config, view_frames(scene, config), ("foreground",))


def make_survey(motion: Mapping[str, str] | None = None, silhouettes: str = "ok") -> Survey:
    """Four pairs that can be matched, and two that are too wide."""
    facts = {
        name: PairFacts("ok", "planar", angle, (540, 300), 20 * angle)
        if angle < 50
        else PairFacts(TOO_WIDE, None, angle)
        for name, angle in zip(PAIRS, ANGLES, strict=True)
    }
    return Survey(facts, silhouettes, motion or {})
