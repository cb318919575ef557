"""Alignment by sound on generated recordings with true clocks: error, doubt and refusals against time.

    python -m benches.audio_sync --output DIR [--part figures|sweeps|rooms|score] [--num-seeds N]

Writes figures.csv (8 phones of one event, solved together), sweeps.csv (one knob at a time on pairs),
rooms.csv (exponents of the whitening in rooms and without; how many errors lie within two sigma) and
score.csv (false accepts and rejects against the threshold). The part `score` also prints the odds that
fit a second set of recordings best, the origin of WAVE_ODDS and BAND_ODDS.
"""

import argparse
import itertools
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import scipy.ndimage
import scipy.signal

from fourd import io
from fourd.align import audio_delay
from fourd.align.audio_delay import SoundMatch, estimate_audio_delay
from fourd.align.clock import PPM, CameraClock
from fourd.align.clock_graph import MIN_SIGMA_S, solve_clocks
from fourd.align.options import AlignOptions
from fourd.align.sound import Sound, prepare_sound

EVENT_HZ = 32_000
KINDS = ("noise", "speech", "music", "claps", "mixed")
# How recordings differ: length, signal to noise, reverberation, microphones, limiter, part muted.
HARD = {"rt60_s": 0.6, "direct_db": -6.0, "unlike": True}
RECORDINGS = {
    "1.5 s, 15 dB": (1.5, {"snr_db": 15.0}),
    "3 s, unlike": (3.0, {"snr_db": 10.0, "unlike": True}),
    "12 s, 10 dB": (12.0, {"snr_db": 10.0}),
    "12 s, -10 dB": (12.0, {"snr_db": -10.0}),
    "8 s, clipped": (8.0, {"snr_db": 5.0, "unlike": True, "clip": 1.0, "rt60_s": 0.5, "direct_db": -3.0}),
    "10 s, 40 % muted": (10.0, {"snr_db": 10.0, "muted": 0.4}),
    "12 s, room": (12.0, {"snr_db": 10.0, **HARD}),
    "15 s, hall": (15.0, {"snr_db": 10.0, "rt60_s": 1.0, "direct_db": -9.0, "unlike": True}),
}
ROOMS = {
    "clean": {"snr_db": 40.0},
    "10 dB": {"snr_db": 10.0},
    "-5 dB": {"snr_db": -5.0},
    "room -6 dB": {"snr_db": 10.0, **HARD},
    "room -12 dB": {"snr_db": 10.0, **HARD, "direct_db": -12.0},
    "hall -9 dB": {"snr_db": 10.0, "rt60_s": 1.0, "direct_db": -9.0, "unlike": True},
    "blocked": {"snr_db": 10.0, "rt60_s": 0.4, "direct_db": -3.0, "unlike": True, "wall": 1.5},
}
WHITENINGS = (0.0, 0.5, 0.7, 0.8, 0.9, 1.0)
ROOM_DURATION_S = 15.0


def band_noise(
    rng: np.random.Generator, count: int, low_hz: float, high_hz: float, slope: float
) -> np.ndarray:
    """Noise of unit power whose density falls with frequency to the power `slope`."""
    spectrum = np.fft.rfft(rng.standard_normal(count))
    frequency = np.fft.rfftfreq(count, 1 / EVENT_HZ)
    spectrum *= (frequency > low_hz) * (frequency < high_hz) / np.maximum(frequency, low_hz) ** (slope / 2)
    wave = np.fft.irfft(spectrum, count)
    return wave / wave.std()


def make_event(kind: str, duration_s: float, rng: np.random.Generator) -> np.ndarray:
    """What there is to hear, EVENT_HZ, unit power."""
    if kind == "noise":
        return band_noise(rng, int(duration_s * EVENT_HZ), 80, 9000, 1)
    if kind == "mixed":
        parts = (make_event(part, duration_s, rng) for part in ("speech", "claps", "noise"))
        return sum(gain * part for gain, part in zip((1.0, 0.5, 0.2), parts, strict=True))  # type: ignore
    makers = {"speech": _syllables, "music": _notes, "claps": _claps}
    out = np.zeros(int(duration_s * EVENT_HZ))
    for time_s, wave in makers[kind](duration_s, rng):
        first = int(time_s * EVENT_HZ)
        out[first : first + len(wave)] += wave[: max(len(out) - first, 0)]
    return out / out.std()


def _syllables(duration_s: float, rng: np.random.Generator):
    time_s = 0.0
    while time_s < duration_s:
        length_s = rng.uniform(0.08, 0.3)
        count = int(length_s * EVENT_HZ)
        pitch = rng.uniform(90, 220) * (1 + 0.1 * np.linspace(-1, 1, count) * rng.standard_normal())
        voiced = scipy.signal.sawtooth(2 * np.pi * np.cumsum(pitch) / EVENT_HZ)
        source = voiced if rng.random() < 0.75 else 0.3 * rng.standard_normal(count)
        for low, high in ((300, 800), (900, 2300), (2400, 3500)):
            b, a = scipy.signal.iirpeak(rng.uniform(low, high), 8, fs=EVENT_HZ)
            source = source + 3 * scipy.signal.lfilter(b, a, source)
        yield time_s, source * np.hanning(count) * rng.uniform(0.3, 1)
        time_s += length_s * rng.uniform(0.7, 1.1) + (rng.uniform(0.2, 0.8) if rng.random() < 0.12 else 0)


def _notes(duration_s: float, rng: np.random.Generator):
    """A bar of 16 eighth notes, repeated, with hi-hat and drum: nearly periodic."""
    step_s = 30 / rng.uniform(90, 140)
    pattern = rng.integers(0, 7, 16)
    time = np.arange(int(0.4 * EVENT_HZ)) / EVENT_HZ
    hat = 0.2 * band_noise(rng, len(time), 3000, 9000, 0) * np.exp(-time / 0.015)
    drum = 0.8 * np.sin(2 * np.pi * 60 * time) * np.exp(-time / 0.04)
    for step in range(int(duration_s / step_s)):
        pitch = 220 * 2 ** (np.array([0, 2, 4, 5, 7, 9, 11])[pattern[step % 16]] / 12 + rng.integers(0, 2))
        tones = (np.sin(2 * np.pi * pitch * k * time + rng.uniform(0, 6)) / k for k in range(1, 7))
        yield step * step_s, 0.5 * sum(tones) * np.exp(-time / 0.15) + hat + (step % 2 == 0) * drum


def _claps(duration_s: float, rng: np.random.Generator):
    yield 0.0, 0.02 * band_noise(rng, int(duration_s * EVENT_HZ), 100, 4000, 1)
    time_s = 0.2
    while time_s < duration_s:
        count = int(0.1 * EVENT_HZ)
        decay = np.exp(-np.arange(count) / (0.012 * EVENT_HZ))
        yield time_s, rng.uniform(0.4, 1) * band_noise(rng, count, 700, 9000, 0) * decay
        time_s += rng.uniform(0.25, 1.2)


def record(
    event: np.ndarray,
    origin_s: float,
    clock: CameraClock,
    duration_s: float,
    rng: np.random.Generator,
    snr_db: float = 10.0,
    rt60_s: float = 0.0,
    direct_db: float = 0.0,
    unlike: bool = False,
    clip: float = 0.0,
    muted: float = 0.0,
    wall: float = 0.0,
) -> np.ndarray:
    """What one phone with that clock records of an event that starts at common time origin_s.

    rt60_s, direct_db: its own echo, and the direct sound against it;  unlike: a random frequency response
    clip: limit in units of its rms, 0 for none;  muted: share of the film in which nothing is heard
    wall: strength of one reflection 2 to 15 ms late against the direct sound, 0.5 to 1.3 times that
    """
    count = int(duration_s * EVENT_HZ)
    if wall:
        late = int(rng.uniform(0.002, 0.015) * EVENT_HZ)
        gain = wall * rng.uniform(0.5, 1.3) * rng.choice([-1, 1])
        event = event + gain * np.concatenate([np.zeros(late), event[:-late]])
    if rt60_s:
        length = int(rt60_s * EVENT_HZ)
        echo = rng.standard_normal(length) * 10 ** (-3 * np.arange(length) / length)
        echo[: int(0.003 * EVENT_HZ)] = 0
        echo *= 10 ** (-direct_db / 20) / np.sqrt((echo**2).sum())
        echo[0] = 1
        event = scipy.signal.fftconvolve(event, echo)[: len(event)]
    at = (clock.common_time(np.arange(count) / EVENT_HZ) - origin_s) * EVENT_HZ
    wave = scipy.ndimage.map_coordinates(event, at[None], order=3, mode="constant")
    if unlike:
        gains = 10 ** (rng.uniform(-10, 10, 12) / 20)
        response = scipy.signal.firwin2(255, np.linspace(0, 1, 12), gains)
        wave = np.asarray(scipy.signal.lfilter(response, 1, wave))
    level = wave.std()
    if muted:
        first = int(rng.uniform(0, 1 - muted) * count)
        wave[first : first + int(muted * count)] = 0
    wave = wave + level * 10 ** (-snr_db / 20) * rng.standard_normal(count)
    wave *= 0.1 / level * rng.uniform(0.3, 1.5)
    limit = clip * wave.std() if clip else 1.0
    return np.clip(wave, -limit, limit).astype(np.float32)


def film_pair(
    kind: str, duration_s: float, setting: dict, seed: int, is_related: bool = True
) -> tuple[list[Sound], list[CameraClock]]:
    """Two films of one event, or of two, and their clocks."""
    rng = np.random.default_rng([seed, KINDS.index(kind), int(duration_s * 10), is_related])
    reach = min(10.0, 0.3 * duration_s)
    clocks = [CameraClock(rng.uniform(-reach, reach), rng.uniform(0, 200)) for _ in range(2)]
    events = [make_event(kind, duration_s + 2 * reach, rng)]
    events.append(events[0] if is_related else make_event(kind, duration_s + 2 * reach, rng))
    sounds = [
        prepare_sound(record(event, -reach, clock, duration_s, rng, **setting), EVENT_HZ)
        for event, clock in zip(events, clocks, strict=True)
    ]
    return sounds, clocks


def match_pair(
    sounds: Sequence[Sound], clocks: Sequence[CameraClock], options: AlignOptions
) -> tuple[SoundMatch, float, float]:
    """The match, its error in the middle of what was compared (s), CPU seconds of matching."""
    start = time.process_time()
    match = estimate_audio_delay(sounds[0], sounds[1], ("left", "right"), options)
    seconds = time.process_time() - start
    delay = match.delay
    true_left_s = clocks[0].own_time(clocks[1].common_time(np.array(delay.time_s)))
    left_s = delay.delay_s + (1 + delay.rate_ppm * PPM) * delay.time_s
    return match, float(left_s - true_left_s), seconds


def summarize(knob: str, value: object, results: Sequence[tuple[SoundMatch, float, float]]) -> dict:
    """A row: of the accepted pairs, errors and doubts, ms; how many are off by > 20 ms."""
    accepted = [(abs(error), match.delay) for match, error, _ in results if match.delay.status == "ok"]
    errors = np.array([error * 1e3 for error, _ in accepted])
    is_within = [error <= 2 * max(delay.sigma_s, MIN_SIGMA_S) for error, delay in accepted]
    return {
        "knob": knob,
        "value": value,
        "error": float(np.median(errors)) if errors.size else float("nan"),
        "error_p95_ms": float(np.percentile(errors, 95)) if errors.size else float("nan"),
        "sigma_ms": float(np.median([delay.sigma_s * 1e3 for _, delay in accepted])) if accepted else 0.0,
        "within_2_sigma": sum(is_within),
        "wrong": int((errors > 20).sum()),
        "refused": len(results) - errors.size,
        "pairs": len(results),
        "seconds": float(np.mean([seconds for *_, seconds in results])),
    }


def run_sweeps(num_seeds: int) -> Iterator[dict]:
    """One knob at a time on pairs of all kinds of events."""
    noisy = {"snr_db": 10.0}
    sweeps = [("snr_db", db, 15.0, {"snr_db": db}, 2.0) for db in (20.0, 10.0, 0.0, -10.0, -15.0)]
    sweeps += [
        ("duration_s", duration_s, duration_s, noisy, 2.0) for duration_s in (1.0, 1.5, 3.0, 10.0, 60.0)
    ]
    sweeps += [("direct_db", db, 15.0, HARD | {"direct_db": db}, 2.0) for db in (6.0, 0.0, -6.0, -12.0)]
    sweeps += [
        ("window_s", window_s, 15.0, HARD | noisy, window_s) for window_s in (0.25, 0.5, 1.0, 2.0, 4.0)
    ]
    for knob, value, duration_s, setting, window_s in sweeps:
        cases = itertools.product(KINDS, range(num_seeds))
        pairs = (film_pair(kind, duration_s, setting, seed) for kind, seed in cases)
        results = [match_pair(*pair, AlignOptions(window_s=window_s)) for pair in pairs]
        yield summarize(knob, value, results)


def run_rooms(num_seeds: int) -> Iterator[dict]:
    """Exponents of the whitening in rooms and without."""
    chosen = audio_delay.WHITENING
    for name, setting in ROOMS.items():
        cases = itertools.product(KINDS, range(num_seeds))
        pairs = [film_pair(kind, ROOM_DURATION_S, setting, 300 + seed) for kind, seed in cases]
        for whitening in WHITENINGS:
            audio_delay.WHITENING = whitening
            yield {"room": name} | summarize(
                "whitening", whitening, [match_pair(*pair, AlignOptions()) for pair in pairs]
            )
    audio_delay.WHITENING = chosen


def run_figures(num_seeds: int, num_phones: int = 8, duration_s: float = 60.0) -> Iterator[dict]:
    """Events of each kind filmed by 8 phones: +-10 s, 0 to 200 ppm, own noise at 10 dB."""
    names = [f"cam{index:02d}" for index in range(num_phones)]
    for kind, seed in itertools.product(KINDS, range(num_seeds)):
        rng = np.random.default_rng([seed, 1000, KINDS.index(kind)])
        event = make_event(kind, duration_s + 20, rng)
        truth = {name: CameraClock(rng.uniform(-10, 10), rng.uniform(0, 200)) for name in names}
        sounds = {
            name: prepare_sound(record(event, -10.0, clock, duration_s, rng), EVENT_HZ)
            for name, clock in truth.items()
        }
        start = time.process_time()
        pairs = [
            estimate_audio_delay(sounds[left], sounds[right], (left, right), AlignOptions()).delay
            for left, right in itertools.combinations(names, 2)
        ]
        clocks, _ = solve_clocks(names, pairs, names[0])
        seconds = time.process_time() - start
        errors, rates = [], []
        for name in names[1:]:
            own_s = np.array([0.0, duration_s])
            true_s = truth[names[0]].own_time(truth[name].common_time(own_s))
            errors.append(float(np.abs(clocks[name].common_time(own_s) - true_s).max()) * 1e3)
            rates.append(abs(clocks[name].rate_ppm - (np.diff(true_s)[0] / duration_s - 1) / PPM))
        yield {
            "kind": kind,
            "seed": seed,
            "error": float(np.median(errors)),
            "error_max_ms": max(errors),
            "rate_error_max_ppm": float(max(rates)),
            "placed": sum(clock.status == "ok" for clock in clocks.values()),
            "seconds": seconds,
        }


def run_score(num_seeds: int) -> Iterator[dict]:
    """False accepts (unrelated, or off by 20 ms) and false rejects against the threshold.

    The odds are fitted to the seeds from 100 on, the rows are of those from 200 on.
    """
    for_fit, for_test = [], []
    for name, (duration_s, setting) in RECORDINGS.items():
        for results, first_seed in ((for_fit, 100), (for_test, 200)):
            for kind, seed, is_related in itertools.product(KINDS, range(num_seeds), (True, False)):
                pair = film_pair(kind, duration_s, setting, first_seed + seed, is_related)
                match, error, _ = match_pair(*pair, AlignOptions())
                results.append((name, match, is_related, is_related and abs(error) < 0.02))
        yield from _count_mistakes(name, [result for result in for_test if result[0] == name])
    yield from _count_mistakes("all", for_test)
    for is_wave, columns in ((True, (0, 2, 3)), (False, (0, 1))):
        mine = [(match.evidence, right) for _, match, _, right in for_fit if match.is_wave == is_wave]
        features = np.array([[1.0, *(evidence[column] for column in columns)] for evidence, _ in mine])
        odds = fit_odds(features, np.array([right for _, right in mine], dtype=float))
        print("odds by", "waveforms" if is_wave else "bands", np.round(odds, 2), "from", len(mine))


def _count_mistakes(name: str, results: Sequence[tuple[str, SoundMatch, bool, bool]]) -> Iterator[dict]:
    """A row per threshold: recordings, match, whether related, whether right."""
    num_related = sum(related for _, _, related, _ in results)
    for threshold in (0.1, 0.3, 0.5, 0.7, 0.9):
        accepted = [(rel, right) for _, match, rel, right in results if match.delay.score >= threshold]
        yield {
            "recordings": name,
            "threshold": threshold,
            "unrelated_accepted": sum(not related for related, _ in accepted),
            "unrelated": len(results) - num_related,
            "related_wrong": sum(related and not right for related, right in accepted),
            "related_refused": num_related - sum(related for related, _ in accepted),
            "related": num_related,
        }


def fit_odds(features: np.ndarray, is_right: np.ndarray) -> np.ndarray:
    """Logistic regression with a weak pull to zero, by Newton's method."""
    odds = np.zeros(features.shape[1])
    for _ in range(100):
        chance = 1 / (1 + np.exp(-np.clip(features @ odds, -30, 30)))
        curvature = (features * (chance * (1 - chance))[:, None]).T @ features + 0.1 * np.eye(len(odds))
        odds = odds + np.linalg.solve(curvature, features.T @ (is_right - chance) - 0.1 * odds)
    return odds


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parts = {"figures": run_figures, "sweeps": run_sweeps, "rooms": run_rooms, "score": run_score}
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--part", choices=parts, nargs="*", default=list(parts))
    parser.add_argument("--num-seeds", type=int, default=3)
    args = parser.parse_args(argv)
    for part in args.part:
        rows = []
        for row in parts[part](args.num_seeds):
            shown = (f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            print("  ".join(shown), flush=True)
            rows.append(row)
            # After every row, so that a run that is cut short leaves what it has.
            io.write_csv(args.output / f"{part}.csv", list(row), rows)


if __name__ == "__main__":
    main()
