"""`listen`: the clocks of all cameras as far as sound alone tells them."""

import dataclasses
import hashlib
import itertools
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.align.audio_delay import SoundMatch, estimate_audio_delay
from fourd.align.clock import CameraClock, Offsets, PairDelay
from fourd.align.clock_graph import attach_clock, solve_clocks
from fourd.align.options import AlignOptions
from fourd.align.sampling import TOO_SHORT, choose_start, find_too_short
from fourd.align.sound import Sound, check_sound, prepare_sound
from fourd.audio import read_audio
from fourd.errors import InputError
from fourd.ingest import read_ingest

log = logging.getLogger(__name__)

# How the status of a copy begins: it is a second witness of nothing, and sight must not take it for one.
SAME_RECORDING = "same recording as"
# Until cameras are known: standard deviation of how much later one camera hears an event than another,
# from 1.7 m of difference in distance.
TRAVEL_SIGMA_S = 5e-3
TRAVEL_NOTE = (
    "clocks by sound include the time that sound travels, 1 ms for 0.34 m of difference in distance; sigma_s "
    f"allows {TRAVEL_SIGMA_S * 1e3:g} ms for it"
)


def read_sounds(ingest_paths: Sequence[Path]) -> tuple[dict[str, Sound], dict[str, str]]:
    """The sound of every film, and for each camera `ok` or the reason why it has none that can be used.

    ingest_paths: ingest/{cam}.json, in the scene's order: of two equal films the first is used
    Raises InputError for a film that is missing or damaged.
    """
    sounds: dict[str, Sound] = {}
    status: dict[str, str] = {}
    first_with: dict[str, str] = {}
    for path in ingest_paths:
        document = read_ingest(path)
        name = str(document["camera"])
        film_key = f"film {document['sha256']}"
        if film_key in first_with:
            status[name] = f"{SAME_RECORDING} {first_with[film_key]}"
            continue
        first_with[film_key] = name
        status[name], sound, sound_key = _read_sound(document)
        if sound is None:
            continue
        if sound_key in first_with:
            status[name] = f"{SAME_RECORDING} {first_with[sound_key]}: their sound is equal in every sample"
            continue
        first_with[sound_key] = name
        sounds[name] = sound
    return sounds, status


def _read_sound(document: Mapping) -> tuple[str, Sound | None, str]:
    """Status, sound, and a key that equal sounds share."""
    if document["kind"] != "video" or not document["has_audio"]:
        return "it has no sound", None, ""
    audio = read_audio(document["source"])
    if audio is None:
        return "it has no sound", None, ""
    status = check_sound(audio.samples, audio.sample_rate)
    if status != "ok":
        return status, None, ""
    digest = hashlib.sha256(audio.samples.tobytes()).hexdigest()
    return "ok", prepare_sound(audio.samples, audio.sample_rate, audio.start_s), f"sound {digest}"


def compare_sounds(
    sounds: Mapping[str, Sound], inputs: Sequence[str], heldout: Sequence[str], options: AlignOptions
) -> list[SoundMatch]:
    """Matches of all pairs of inputs, and of every held-out camera with every input, in order."""
    able = [name for name in inputs if name in sounds]
    pairs = list(itertools.combinations(able, 2))
    pairs += [(name, other) for other in heldout if other in sounds for name in able]
    matches = []
    for left, right in pairs:
        match = estimate_audio_delay(sounds[left], sounds[right], (left, right), options)
        delay = match.delay
        log.info("%s %s: %.4f s, score %.2f: %s", left, right, delay.delay_s, delay.score, delay.status)
        matches.append(match)
    return matches


def solve_by_sound(
    pairs: Sequence[PairDelay],
    status: Mapping[str, str],
    inputs: Sequence[str],
    heldout: Sequence[str],
) -> Offsets:
    """Clocks from delays: the inputs among themselves, then each held-out camera against them.

    status: by camera, why its sound cannot be compared, `ok` where it can
    `start_s` of the result is None.
    """
    clocks = {name: CameraClock(0.0, 0.0, 0.0, 0.0, "audio", status[name]) for name in (*inputs, *heldout)}
    notes = [f"{name}: {clock.status}" for name, clock in clocks.items() if clock.status != "ok"]
    able = [name for name in inputs if status[name] == "ok"]
    # Sight may place what has no sound, but not a film that nobody looks at.
    reference = next((name for name in inputs if not status[name].startswith(TOO_SHORT)), inputs[0])
    if able:
        solved, more = solve_clocks(able, pairs, able[0])
        clocks |= solved
        reference = next((name for name in able if solved[name].method == "reference"), reference)
        notes += more
        if able[0] != inputs[0]:
            notes.append(f"times are relative to {reference}: {inputs[0]} cannot be compared")
    fixed = {name: clocks[name] for name in inputs}
    for name in heldout:
        if status[name] == "ok":
            clocks[name] = attach_clock(name, pairs, fixed)
    placed = [name for name, clock in clocks.items() if clock.status == "ok" and name != reference]
    for name in placed:
        sigma_s = math.hypot(clocks[name].sigma_s, TRAVEL_SIGMA_S)
        clocks[name] = dataclasses.replace(clocks[name], sigma_s=sigma_s)
    if placed:
        notes.append(TRAVEL_NOTE)
    return Offsets(reference, clocks, None, tuple(pairs), tuple(notes))


def run_listen(
    ingest_paths: Sequence[Path],
    inputs: Sequence[str],
    heldout: Sequence[str],
    fps: float,
    num_frames: int,
    options: AlignOptions,
    start_s: float | None = None,
) -> tuple[Offsets, list[SoundMatch]]:
    """Clocks by sound, content of align/audio.json, and the comparisons that they rest on.

    ingest_paths: ingest/{cam}.json of all cameras, in the scene's order;  fps, num_frames: of the scene
    start_s: common time of scene frame 0 where the scene says it; otherwise the earliest from which all
    placed inputs film, None where there is none
    A film that is too short for the scene is not listened to.
    Raises InputError for a camera without an ingest file and for a film that cannot be read.
    """
    names = (*inputs, *heldout)
    read = [(read_ingest(path), path) for path in ingest_paths]
    documents = {document["camera"]: document for document, _ in read}
    paths = {document["camera"]: path for document, path in read}
    missing = [name for name in names if name not in documents]
    if missing:
        raise InputError(
            f"expected ingest files of all cameras, got none of {', '.join(missing)}: name them all"
        )
    pts = {name: np.asarray(documents[name]["pts_s"], dtype=np.float64) for name in names}
    too_short = find_too_short(pts, inputs, fps, num_frames)
    sounds, status = read_sounds([paths[name] for name in names if name not in too_short])
    matches = compare_sounds(sounds, inputs, heldout, options)
    offsets = solve_by_sound([match.delay for match in matches], status | too_short, inputs, heldout)
    placed = {name: offsets.clocks[name] for name in inputs if offsets.clocks[name].status == "ok"}
    if start_s is not None or len(placed) < 2:
        return dataclasses.replace(offsets, start_s=start_s), matches
    try:
        start_s = choose_start(placed, pts, fps, num_frames)
    except InputError as error:
        return dataclasses.replace(offsets, notes=(*offsets.notes, str(error))), matches
    return dataclasses.replace(offsets, start_s=start_s), matches
