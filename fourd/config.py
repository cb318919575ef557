"""Configuration and scene files: defaults and checks from the JSON schemas, one sentence per fault."""

import copy
import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jsonschema
import yaml

from fourd.errors import InputError
from fourd.trajectory import scene_frames

SCHEMA_FOLDER = Path(__file__).resolve().parents[1] / "config" / "schemas"

# Two directions of int16 disparity and uint8 confidence; a rectified image is about as large as a film's.
PAIR_BYTES_PER_PIXEL = 2 * (2 + 1)
# Four estimates with masks, depth and counts, and two backgrounds with depth (docs/formats.md).
FUSED_BYTES_PER_PIXEL = 23 + 13


def load_yaml(path: Path | str) -> dict[str, Any]:
    """A YAML mapping. Raises InputError if the file is missing, malformed or no mapping."""
    source = Path(path)
    if not source.is_file():
        raise InputError(f"expected a file at {source}, found nothing: check the name")
    try:
        text = source.read_text(encoding="utf-8")
        # A few nested aliases stand for more entries than there is memory.
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
            raise yaml.YAMLError("an alias (*NAME), write the part out")
        document = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"expected YAML in {source}, got: {' '.join(str(error).split())}") from None
    if not isinstance(document, dict):
        raise InputError(f"expected a mapping of keys in {source}, got {type(document).__name__}")
    return document


def load_config_schema(folder: Path = SCHEMA_FOLDER) -> dict[str, Any]:
    """The schema of the whole configuration: config.schema.yaml plus one section per other file."""
    schema = load_yaml(folder / "config.schema.yaml")
    for path in sorted(folder.glob("*.schema.yaml")):
        section = path.name.removesuffix(".schema.yaml")
        if section not in ("config", "scene", "edit_file"):
            schema["properties"][section] = load_yaml(path)
    return schema


def fill_defaults(document: dict[str, Any], schema: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of a mapping in which missing keys have the schema's defaults, at every depth."""
    filled = copy.deepcopy(document)
    for key, entry in schema.get("properties", {}).items():
        if key not in filled:
            if "default" in entry:
                filled[key] = copy.deepcopy(entry["default"])
            elif entry.get("type") == "object":
                filled[key] = {}
            else:
                continue
        if isinstance(filled[key], dict):
            filled[key] = fill_defaults(filled[key], entry)
    extra = schema.get("additionalProperties")
    if isinstance(extra, Mapping):
        for key in set(filled) - set(schema.get("properties", {})):
            if isinstance(filled[key], dict):
                filled[key] = fill_defaults(filled[key], extra)
    return filled


def validate(document: Mapping[str, Any], schema: Mapping[str, Any], where: str) -> None:
    """Check a mapping; raise InputError with key, value and what is allowed for the first fault."""
    validator = jsonschema.Draft202012Validator(schema)
    errors = sorted(validator.iter_errors(document), key=lambda e: [str(p) for p in e.absolute_path])
    if errors:
        raise InputError(_explain(errors[0], where))


def read_words(value: Any, schema: Mapping[str, Any]) -> Any:
    """A copy in which text stands for a number, list or truth value where the schema wants one.

    The engine hands nested values of `--config 'fuse={min_pairs: 4}'` over as text.
    """
    if isinstance(value, Mapping):
        properties, others = schema.get("properties", {}), schema.get("additionalProperties")
        fallback = others if isinstance(others, Mapping) else {}
        return {key: read_words(item, properties.get(key, fallback)) for key, item in value.items()}
    if isinstance(value, list):
        return [read_words(item, schema.get("items", {})) for item in value]
    kinds = schema.get("type", ())
    if isinstance(value, str) and kinds and "string" not in kinds:
        return yaml.safe_load(value)
    return value


def expand_presets(document: Mapping[str, Any], schema: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A copy in which a section given by the name of a preset holds all of its keys.

    All keys, so that what a scene sets for the section does not mix with the preset.
    Raises InputError for a name that the section does not know.
    """
    expanded = dict(document)
    for section, value in document.items():
        presets = schema["properties"].get(section, {}).get("presets", {})
        if not isinstance(value, str) or not presets:
            continue
        if value not in presets:
            raise InputError(
                f"{where}: {section} is {value!r}, expected a mapping of keys or one of {', '.join(presets)}"
            )
        expanded[section] = fill_defaults(dict(presets[value]), schema["properties"][section])
    return expanded


def _explain(error: jsonschema.ValidationError, where: str) -> str:
    key = ".".join(str(part) for part in error.absolute_path) or "the file"
    rule: Any = error.validator_value
    if error.validator == "additionalProperties":
        known = sorted(error.schema.get("properties", {}))  # type: ignore[union-attr]
        unknown = sorted(set(error.instance) - set(known))  # type: ignore[arg-type]
        names = ", ".join(map(repr, unknown))
        return f"{where}: unknown key {names} in {key}; known keys are {', '.join(known)}"
    if error.validator == "required":
        return f"{where}: {error.message} in {key}"
    allowed = {
        "type": f"type {rule}",
        "enum": f"one of {rule}",
        "minimum": f"at least {rule}",
        "maximum": f"at most {rule}",
        "exclusiveMinimum": f"more than {rule}",
        "exclusiveMaximum": f"less than {rule}",
        "pattern": f"text that matches {rule}",
        "minItems": f"at least {rule} entries",
        "maxItems": f"at most {rule} entries",
    }.get(str(error.validator), error.message)
    return f"{where}: {key} is {error.instance!r}, expected {allowed}"


def merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """Keys of `above` win over those of `below`, section by section."""
    merged = dict(below)
    for key, value in above.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


@dataclasses.dataclass(frozen=True)
class CameraSource:
    """Where a physical camera's frames come from (scene file, `cameras`).

    offset_s: given common time of the first frame, None where it is to be found
    background: what it filmed from the same place with nobody there, if anything
    """

    source: str
    offset_s: float | None
    calibration_name: str
    background: str | None = None


@dataclasses.dataclass(frozen=True)
class Scene:
    """The facts of one event, checked.

    clock_is_given: the cameras' offset_s are facts; otherwise sound and motion tell them
    start_s: common time of scene frame 0, None for the earliest that all cameras film
    calibration: files with the cameras, none where the videos themselves must tell
    scale_hint: two cameras and their distance in metres
    """

    name: str
    fps: float
    num_frames: int
    start_s: float | None
    clock_is_given: bool
    size: tuple[int, int]
    cameras: dict[str, CameraSource]
    heldout: tuple[str, ...]
    calibration: tuple[str, ...]
    calibration_format: str
    scale_hint: tuple[str, str, float] | None
    depth_range: tuple[float, float] | None
    labels: str | None

    @property
    def inputs(self) -> tuple[str, ...]:
        """Cameras that everything is made from, in the scene's order."""
        return tuple(name for name in self.cameras if name not in self.heldout)

    @property
    def pairs(self) -> tuple[str, ...]:
        """All N-choose-2 pairs of input cameras, LEFT-RIGHT in the scene's order."""
        return tuple(f"{left}-{right}" for left, right in itertools.combinations(self.inputs, 2))


def load_scene(name: str, folder: Path | str = "config/scenes") -> tuple[Scene, dict[str, Any]]:
    """A scene file, checked, and the settings it carries. Raises InputError."""
    path = Path(folder) / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in Path(folder).glob("*.yaml"))) or "none"
        raise InputError(
            f"scene {name!r}: expected a file at {path}, found nothing; known scenes are {known}. "
            f"`python -m fourd.init {name} VIDEO_OR_FOLDER...` writes one"
        )
    document = load_yaml(path)
    schema = load_yaml(SCHEMA_FOLDER / "scene.schema.yaml")
    validate(document, schema, str(path))
    document = fill_defaults(document, schema)
    clock_is_given = document["clock"] == "given"
    cameras = {}
    for camera, entry in document["cameras"].items():
        offset_s = entry["offset_s"]
        if offset_s is not None and not clock_is_given:
            raise InputError(
                f"{path}: camera {camera} has offset_s {offset_s}, but the clock is to be estimated: add "
                "`clock: given` if all offsets are known, or take offset_s out"
            )
        cameras[camera] = CameraSource(
            entry["source"],
            (offset_s or 0.0) if clock_is_given else None,
            entry["calibration_name"] or camera,
            entry["background"],
        )
    hint = document["scale_hint"]
    scene = Scene(
        name=name,
        fps=document["fps"],
        num_frames=document["num_frames"],
        start_s=0.0 if clock_is_given and document["start_s"] is None else document["start_s"],
        clock_is_given=clock_is_given,
        size=tuple(document["size"]),
        cameras=cameras,
        heldout=tuple(document["heldout"]),
        calibration=tuple(document["calibration"]),
        calibration_format=document["calibration_format"],
        scale_hint=None if hint is None else (*hint["cameras"], hint["metres"]),
        depth_range=None if document["depth_range"] is None else tuple(document["depth_range"]),
        labels=document["labels"],
    )
    _check_scene(scene, str(path))
    return scene, document["settings"]


def _check_scene(scene: Scene, where: str) -> None:
    for name in scene.heldout:
        if name not in scene.cameras:
            raise InputError(
                f"{where}: heldout names {name!r}, which is no camera; cameras are {', '.join(scene.cameras)}"
            )
    if len(scene.inputs) < 2:
        raise InputError(
            f"{where}: expected at least 2 cameras that are not held out, got {len(scene.inputs)}: "
            "depth needs two views, add cameras or hold out fewer"
        )
    if scene.scale_hint is not None:
        unknown = [name for name in scene.scale_hint[:2] if name not in scene.cameras]
        if unknown or scene.scale_hint[0] == scene.scale_hint[1]:
            raise InputError(
                f"{where}: scale_hint names {', '.join(scene.scale_hint[:2])}, expected two different "
                f"cameras of {', '.join(scene.cameras)}"
            )
    if scene.depth_range is not None and scene.depth_range[0] >= scene.depth_range[1]:
        raise InputError(f"{where}: depth_range is {list(scene.depth_range)}, expected near less than far")


def load_config(given: Mapping[str, Any], scene_settings: Mapping[str, Any], scene: str) -> dict[str, Any]:
    """The full configuration: schema defaults, below the scene's settings, below what was given."""
    schema = load_config_schema()
    given = expand_presets(read_words(given, schema), schema, "configuration")
    scene_settings = expand_presets(scene_settings, schema, f"scene {scene}, settings")
    validate(given, schema, "configuration")
    validate(scene_settings, schema, f"scene {scene}, settings")
    return fill_defaults(merge(scene_settings, given), schema)


def chunk_names(num_frames: int, chunk_frames: int) -> tuple[str, ...]:
    """Chunks `FIRST-LAST` (inclusive) that cover frames 0 .. num_frames - 1; the last may be short."""
    return tuple(
        f"{first:06d}-{min(first + chunk_frames, num_frames) - 1:06d}"
        for first in range(0, num_frames, chunk_frames)
    )


def frames_of_chunk(chunk: str) -> range:
    """Frames of a chunk name."""
    first, last = chunk.split("-")
    return range(int(first), int(last) + 1)


def spread_frames(num_frames: int, count: int) -> tuple[int, ...]:
    """`count` frames (or all, if fewer) evenly spread over the clip, each in the middle of its share."""
    count = min(count, num_frames)
    return tuple((2 * i + 1) * num_frames // (2 * count) for i in range(count))


def stage_version(stage: str) -> int:
    """`STAGE_VERSION` of a stage's module, read without importing it (imports cost seconds).

    Passed as a parameter of the rule, it makes a change of code visible to the workflow engine.
    """
    package = Path(__file__).resolve().parent / stage
    source = package / "__init__.py" if package.is_dir() else package.with_suffix(".py")
    for line in source.read_text(encoding="utf-8").splitlines():
        if line.startswith("STAGE_VERSION = "):
            return int(line.removeprefix("STAGE_VERSION = "))
    raise InputError(f"{source}: expected a line STAGE_VERSION = NUMBER, found none: add it")


def num_levels(scene: Scene, config: Mapping[str, Any]) -> int:
    """Resolutions of the composition that the films' size calls for (paper 4.1).

    The paper's levels are 270, 540 and 1080 lines. A level is left out when the films have fewer
    than three quarters of its lines; `max_levels` bounds the number further.
    """
    lines = min(scene.size)
    wanted = 1 + sum(lines >= 0.75 * level_lines for level_lines in (540, 1080))
    return min(wanted, config["max_levels"])


def fit_chunk_frames(config: Mapping[str, Any], scene: Scene) -> int:
    """`chunk_frames`, refused with a proposal when the number of jobs would be unworkable."""
    chunk_frames = config["chunk_frames"]

    def estimate_jobs(frames: int) -> int:
        chunks = -(-scene.num_frames // frames)
        views = len(scene.cameras) + len(config["trajectories"])
        return len(scene.pairs) * (chunks + 2) + chunks + views * (3 * chunks + 2) + 2 * len(scene.cameras)

    if estimate_jobs(chunk_frames) > config["max_jobs"]:
        fits = chunk_frames
        while estimate_jobs(fits) > config["max_jobs"] and fits < scene.num_frames:
            fits *= 2
        raise InputError(
            f"scene {scene.name} with chunk_frames {chunk_frames} means about "
            f"{estimate_jobs(chunk_frames)} jobs, more than max_jobs {config['max_jobs']}: "
            f"use chunk_frames {min(fits, scene.num_frames)} or more, or raise max_jobs"
        )
    return chunk_frames


def kept_intermediates(
    scene: Scene, config: Mapping[str, Any], frames: Mapping[str, Mapping[int, int]]
) -> frozenset[str]:
    """Which of `foreground` and `disparity` stay on the disk after the run, within `keep_gb`.

    Foregrounds (with their backgrounds) come first: with them a changed network or score touches
    nothing above it. Disparities are what a new trajectory needs.
    """
    pixels = scene.size[0] * scene.size[1]
    num_samples = min(config["background"]["num_samples"], scene.num_frames)
    sizes = {
        "foreground": sum(map(len, frames.values())) * pixels * FUSED_BYTES_PER_PIXEL,
        "disparity": len(scene.pairs) * (scene.num_frames + num_samples) * pixels * PAIR_BYTES_PER_PIXEL,
    }
    kept: set[str] = set()
    total = 0
    for name, size in sizes.items():
        total += size
        if total <= config["keep_gb"] * 1e9:
            kept.add(name)
    return frozenset(kept)


def view_frames(scene: Scene, config: Mapping[str, Any]) -> dict[str, dict[int, int]]:
    """Output frame -> scene frame, for every physical camera and every trajectory.

    Raises InputError if a trajectory shows a frame that the clip does not have, or has a camera's name.
    """
    frames = {}
    for cameras, key in ((scene.inputs, "train_frames"), (scene.heldout, "heldout_frames")):
        for name in cameras:
            frames[name] = {f: f for f in spread_frames(scene.num_frames, config["views"][key])}
    for name, spec in config["trajectories"].items():
        if name in frames:
            raise InputError(f"trajectory {name!r} has the name of a camera: rename one of them")
        frames[name] = dict(enumerate(scene_frames(spec, scene.num_frames)))
    return frames
