"""Common colours: which cameras need a correction, and its tables. Gives frames/colour.json."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fourd.frames.fit import ColourModel, fit_colours
from fourd.frames.observations import ColourPairs, count_matches, observe_colours
from fourd.frames.options import FramesOptions
from fourd.sfm import SceneCameras, SfmOptions
from fourd.sfm.sparse import select_pairs, sparse_frames
from fourd.tone import NUM_LEVELS

# Levels at which corrections are compared: what pictures mostly consist of.
LEVELS = np.arange(24.0, 233.0, 8.0)
# A correction smaller than this many of its own deviations is none.
_MIN_SIGMAS = 3.0

ReadFrame = Callable[[str, int], np.ndarray]


@dataclasses.dataclass(frozen=True, eq=False)
class CameraColour:
    """The correction of one camera.

    status: `ok`, or why there is none;  num_matches: points compared with other cameras
    gain, gamma: (K, 3) and (3,), level v in 0..1 becomes gain * v ** gamma at the sampled frames
    sigma_levels, change_levels: root mean square over levels, channels and frames
    is_needed: the change is larger than its uncertainty and than what is worth a correction
    """

    status: str
    num_matches: int
    gain: np.ndarray
    gamma: np.ndarray
    sigma_levels: float
    change_levels: float
    is_needed: bool

    def tables(self) -> np.ndarray:
        """(K, 3, 256) uint8."""
        level = np.arange(NUM_LEVELS) / (NUM_LEVELS - 1)
        corrected = self.gain[:, :, None] * level ** self.gamma[:, None]
        return np.clip(np.rint(255 * corrected), 0, 255).astype(np.uint8)


def match_colours(
    scene: SceneCameras, names: Sequence[str], read_frame: ReadFrame, options: FramesOptions
) -> tuple[tuple[int, ...], str | None, dict[str, CameraColour]]:
    """Corrections that bring cameras to the colours of the median one, which stays as it is.

    names: cameras that can be read;  read_frame: (name, scene frame) -> (H, W, 3) uint8 RGB
    Held-out cameras are compared with the finished inputs; nothing of an input depends on them.
    Returns the sampled scene frames, the reference (None if no two cameras could be compared) and
    the cameras.
    """
    frames = tuple(sparse_frames(scene.num_frames, options.num_colour_frames))
    inputs = [name for name in scene.inputs if name in names]
    observed = _observe(scene, inputs, None, frames, read_frame)
    linked = _largest_group(inputs, observed, options.min_colour_matches)
    counts = count_matches(observed, inputs)
    colours = {name: _refused(counts[name], frames, options) for name in inputs}
    if len(linked) < 2:
        return (
            frames,
            None,
            {**colours, **{n: _refused(0, frames, options) for n in names if n not in inputs}},
        )
    within = [pairs for pairs in observed if pairs.left in linked and pairs.right in linked]
    reference, finished = _fit_inputs(within, linked, frames, counts, options)
    colours |= finished
    for name in names:
        if name not in inputs:
            colours[name] = _fit_heldout(scene, name, finished, frames, read_frame, options)
    return frames, reference, colours


def _observe(
    scene: SceneCameras,
    inputs: Sequence[str],
    heldout: str | None,
    frames: Sequence[int],
    read_frame: ReadFrame,
) -> list[ColourPairs]:
    """Colours seen by neighbouring inputs, or by one held-out camera and its neighbours."""
    names = [*inputs] if heldout is None else [*inputs, heldout]
    middle = frames[len(frames) // 2]
    pairs = select_pairs({name: scene.tracks[name].at(middle) for name in names}, SfmOptions())
    if heldout is not None:
        pairs = [pair for pair in pairs if heldout in pair]
    return observe_colours(
        pairs, frames, lambda name, frame: scene.tracks[name].at(frame), read_frame, SfmOptions()
    )


def _largest_group(names: Sequence[str], observed: Sequence[ColourPairs], min_matches: int) -> list[str]:
    """The most cameras that are linked by pairs with enough matches, in the order of `names`."""
    totals: dict[tuple[str, str], int] = {}
    for pairs in observed:
        key = (pairs.left, pairs.right)
        totals[key] = totals.get(key, 0) + len(pairs.left_levels)
    group = {name: {name} for name in names}
    for (left, right), total in totals.items():
        if total >= min_matches and group[left] is not group[right]:
            merged = group[left] | group[right]
            group |= dict.fromkeys(merged, merged)
    largest = max((group[name] for name in names), key=len, default=set())
    return [name for name in names if name in largest]


def _fit_inputs(
    observed: Sequence[ColourPairs],
    names: Sequence[str],
    frames: Sequence[int],
    counts: Mapping[str, int],
    options: FramesOptions,
) -> tuple[str, dict[str, CameraColour]]:
    """The reference, and all inputs: fitted, the needless ones set to identity, the others fitted again."""
    unchanged = np.zeros((len(frames), 3)), np.ones(3)
    reference = names[_median_camera(fit_colours(observed, names, frames, {names[0]: unchanged}))]
    first = fit_colours(observed, names, frames, {reference: unchanged})
    judged = {name: _judge(first, name, counts[name], options) for name in names}
    # Rounding is no change, even where every change counts.
    judged[reference] = dataclasses.replace(judged[reference], is_needed=False)
    fixed = {name: unchanged for name in names if not judged[name].is_needed}
    final = fit_colours(observed, names, frames, fixed)
    return reference, {
        name: judged[name] if name in fixed else dataclasses.replace(
            _judge(final, name, counts[name], options), is_needed=True
        )
        for name in names
    }  # fmt: skip


def _median_camera(model: ColourModel) -> int:
    """Index of the camera whose correction lies nearest to all others."""
    curves = np.stack([model.corrected(camera, LEVELS).ravel() for camera in range(len(model.names))])
    distance = np.sqrt(((curves[:, None] - curves[None]) ** 2).mean(axis=2))
    return int(distance.sum(axis=1).argmin())


def _fit_heldout(
    scene: SceneCameras,
    name: str,
    finished: Mapping[str, CameraColour],
    frames: Sequence[int],
    read_frame: ReadFrame,
    options: FramesOptions,
) -> CameraColour:
    observed = _observe(scene, list(finished), name, frames, read_frame)
    count = count_matches(observed, [name])[name]
    if count < options.min_colour_matches:
        return _refused(count, frames, options)
    fixed = {
        other: (np.log(colour.gain), colour.gamma)
        if colour.is_needed
        else (np.zeros((len(frames), 3)), np.ones(3))
        for other, colour in finished.items()
    }
    return _judge(fit_colours(observed, [*finished, name], frames, fixed), name, count, options)


def _judge(model: ColourModel, name: str, num_matches: int, options: FramesOptions) -> CameraColour:
    """What the model says about one camera, and whether it is worth a table."""
    camera = model.names.index(name)
    change = np.clip(model.corrected(camera, LEVELS), 0, 255) - LEVELS
    change_levels = float(np.sqrt((change**2).mean()))
    sigma_levels = float(np.sqrt((model.sigma_levels(camera, LEVELS) ** 2).mean()))
    return CameraColour(
        status="ok",
        num_matches=num_matches,
        gain=np.exp(model.log_gain[camera]),
        gamma=model.gamma[camera],
        sigma_levels=sigma_levels,
        change_levels=change_levels,
        is_needed=change_levels > max(options.min_colour_change, _MIN_SIGMAS * sigma_levels),
    )


def _refused(num_matches: int, frames: Sequence[int], options: FramesOptions) -> CameraColour:
    status = (
        f"{num_matches} static points compared with other cameras, {options.min_colour_matches} with one "
        "linked camera are needed"
    )
    return CameraColour(status, num_matches, np.ones((len(frames), 3)), np.ones(3), 0.0, 0.0, False)


def describe_colour(colour: CameraColour, frames: Sequence[int]) -> dict[str, Any]:
    """JSON form of one camera of frames/colour.json; `tone` is what `fourd.tone.table_at` reads."""
    tone = None
    if colour.is_needed:
        tables = colour.tables()
        steady = bool((tables == tables[:1]).all())
        kept = 1 if steady else len(frames)
        tone = {"frames": list(frames)[:kept], "tables": tables[:kept].tolist()}
    return {
        "status": colour.status,
        "num_matches": colour.num_matches,
        "is_needed": colour.is_needed,
        "gain": colour.gain.tolist(),
        "gamma": colour.gamma.tolist(),
        "sigma_levels": colour.sigma_levels,
        "change_levels": colour.change_levels,
        "tone": tone,
    }
