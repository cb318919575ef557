"""Alignment by sound on generated recordings with true clocks: error, doubt and refusals against time.

    python -m benches.audio_sync --output DIR [--part figures|sweeps|score] [--num-seeds N]

Writes figures.csv (8 phones of one event, solved together), sweeps.csv (one knob at a time on pairs) and
score.csv (false accepts and rejects against the threshold). The part `score` also prints the odds that
fit its recordings best, the origin of WAVE_ODDS and BAND_ODDS.
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import scipy.ndimage
import scipy.signal

from fourd import io
from fourd.align import audio_delay
from fourd.align.audio_delay import SoundMatch, estimate_audio_delay
from fourd.align.clock import PPM, CameraClock
from fourd.align.clock_graph import solve_clocks
from fourd.align.options import AlignOptions
from fourd.align.sound import prepare_sound

EVENT_HZ = 48_000
KINDS = ("noise", "speech", "music", "claps", "mixed")
# How recordings differ: length, signal to noise, reverberation, microphones, limiter, part muted.
HARD = {"rt60_s": 0.6, "direct_db": -6.0, "unlike": True}
RECORDINGS = {
    "1.5 s, 15 dB": (1.5, {"snr_db": 15.0}),
    "3 s, unlike": (3.0, {"snr_db": 10.0, "unlike": True}),
    "20 s, 10 dB": (20.0, {"snr_db": 10.0}),
    "20 s, -10 dB": (20.0, {"snr_db": -10.0}),
    "8 s, clipped": (8.0, {"snr_db": 5.0, "unlike": True, "clip": 1.0, "rt60_s": 0.5, "direct_db": -3.0}),
    "10 s, 40 % muted": (10.0, {"snr_db": 10.0, "muted": 0.4}),
    "20 s, room": (20.0, {"snr_db": 10.0, **HARD}),
    "30 s, hall": (30.0, {"snr_db": 10.0, "rt60_s": 1.0, "direct_db": -9.0, "unlike": True}),
}


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
) -> np.ndarray:
    """What one phone with that clock records of an event that starts at common time origin_s.

    rt60_s, direct_db: its own echo, and the direct sound against it;  unlike: a random frequency response
    clip: limit in units of its rms, 0 for none;  muted: share of the film in which nothing is heard
    """
    count = int(duration_s * EVENT_HZ)
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
        wave = scipy.signal.lfilter(scipy.signal.firwin2(255, np.linspace(0, 1, 12), gains), 1, wave)
    level = wave.std()
    if muted:
        first = int(rng.uniform(0, 1 - muted) * count)
        wave[first : first + int(muted * count)] = 0
    wave = wave + level * 10 ** (-snr_db / 20) * rng.standard_normal(count)
    wave *= 0.1 / level * rng.uniform(0.3, 1.5)
    limit = clip * wave.std() if clip else 1.0
    return np.clip(wave, -limit, limit).astype(np.float32)


def compare(
    kind: str, duration_s: float, setting: dict, seed: int, options: AlignOptions, is_related: bool = True
) -> tuple[SoundMatch, float, float]:
    """One pair: its match, the error in the middle of what was compared (s), CPU seconds of matching."""
    rng = np.random.default_rng([seed, KINDS.index(kind), int(duration_s * 10), is_related])
    reach = min(10.0, 0.3 * duration_s)
    clocks = [CameraClock(rng.uniform(-reach, reach), rng.uniform(0, 200)) for _ in range(2)]
    events = [make_event(kind, duration_s + 2 * reach, rng)]
    events.append(events[0] if is_related else make_event(kind, duration_s + 2 * reach, rng))
    left, right = (
        prepare_sound(record(event, -reach, clock, duration_s, rng, **setting), EVENT_HZ)
        for event, clock in zip(events, clocks, strict=True)
    )
    start = time.process_time()
    match = estimate_audio_delay(left, right, ("left", "right"), options)
    seconds = time.process_time() - start
    delay = match.delay
    true_left_s = clocks[0].own_time(clocks[1].common_time(np.array(delay.time_s)))
    left_s = delay.delay_s + (1 + delay.rate_ppm * PPM) * delay.time_s
    return match, float(left_s - true_left_s), seconds


def summarize(knob: str, value: object, results: Sequence[tuple[SoundMatch, float, float]]) -> dict:
    """A row: median and 95th percentile of the accepted pairs' errors, ms; how many are off by > 20 ms."""
    errors = np.array([abs(error) * 1e3 for match, error, _ in results if match.delay.status == "ok"])
    row = {
        "knob": knob,
        "value": value,
        "error": float(np.median(errors)) if errors.size else float("nan"),
        "error_p95_ms": float(np.percentile(errors, 95)) if errors.size else float("nan"),
        "wrong": int((errors > 20).sum()),
        "refused": len(results) - errors.size,
        "pairs": len(results),
        "seconds": float(np.mean([seconds for *_, seconds in results])),
    }
    print(
        "  ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), flush=True
    )
    return row


def run_sweeps(num_seeds: int) -> list[dict]:
    rows = []

    def sweep(knob: str, value: object, duration_s: float, setting: dict, options: AlignOptions) -> None:
        cases = itertools.product(KINDS, range(num_seeds))
        results = [compare(kind, duration_s, setting, seed, options) for kind, seed in cases]
        rows.append(summarize(knob, value, results))

    default = AlignOptions()
    for snr_db in (20.0, 10.0, 0.0, -10.0, -15.0):
        sweep("snr_db", snr_db, 20, {"snr_db": snr_db}, default)
    for duration_s in (1.0, 1.5, 3.0, 10.0, 60.0):
        sweep("duration_s", duration_s, duration_s, {"snr_db": 10.0}, default)
    for direct_db in (6.0, 0.0, -6.0, -12.0):
        sweep("direct_db", direct_db, 20, HARD | {"direct_db": direct_db}, default)
    for window_s in (0.25, 0.5, 1.0, 2.0, 4.0):
        sweep("window_s", window_s, 20, HARD, AlignOptions(window_s=window_s))
    chosen = audio_delay.WHITENING
    for whitening in (0.0, 0.5, 0.7, 0.8, 0.9, 1.0):
        audio_delay.WHITENING = whitening
        sweep("whitening", whitening, 20, HARD, default)
        sweep("whitening, no room", whitening, 20, {"snr_db": -6.0}, default)
    audio_delay.WHITENING = chosen
    return rows


def run_figures(num_seeds: int, num_phones: int = 8, duration_s: float = 60.0) -> list[dict]:
    """Events of each kind filmed by 8 phones: +-10 s, 0 to 200 ppm, own noise at 10 dB."""
    rows = []
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
        row = {
            "kind": kind,
            "seed": seed,
            "error": float(np.median(errors)),
            "error_max_ms": max(errors),
            "rate_error_max_ppm": float(max(rates)),
            "placed": sum(clock.status == "ok" for clock in clocks.values()),
            "seconds": seconds,
        }
        rows.append(row)
        print(
            "  ".join(f"{k} {v:.4f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()),
            flush=True,
        )
    return rows


def run_score(num_seeds: int) -> list[dict]:
    """False accepts (unrelated, or off by 20 ms) and false rejects against the threshold."""
    results = []
    for name, (duration_s, setting) in RECORDINGS.items():
        for kind, seed, is_related in itertools.product(KINDS, range(num_seeds), (True, False)):
            match, error, _ = compare(kind, duration_s, setting, 100 + seed, AlignOptions(), is_related)
            results.append((name, match, is_related, is_related and abs(error) < 0.02))
    rows = []
    for threshold in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95):
        accepted = [
            (related, right) for _, match, related, right in results if match.delay.score >= threshold
        ]
        num_related = sum(related for _, _, related, _ in results)
        row = {
            "threshold": threshold,
            "unrelated_accepted": sum(not related for related, _ in accepted),
            "unrelated": len(results) - num_related,
            "related_wrong": sum(related and not right for related, right in accepted),
            "related_refused": num_related - sum(related for related, _ in accepted),
            "related": num_related,
        }
        rows.append(row)
        print("  ".join(f"{k} {v}" for k, v in row.items()))
    for name in RECORDINGS:
        mine = [(match, related) for other, match, related, _ in results if other == name]
        refused = sum(related and match.delay.status != "ok" for match, related in mine)
        print(f"{name}: {refused} of {len(mine) // 2} refused")
    for is_wave, columns in ((True, (0, 2, 3)), (False, (0, 1))):
        mine = [(match.evidence, right) for _, match, _, right in results if match.is_wave == is_wave]
        features = np.array([[1.0, *(evidence[column] for column in columns)] for evidence, _ in mine])
        odds = fit_odds(features, np.array([right for _, right in mine], dtype=float))
        print("odds by", "waveforms" if is_wave else "bands", np.round(odds, 2))
    return rows


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
    parts = {"figures": run_figures, "sweeps": run_sweeps, "score": run_score}
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--part", choices=parts, nargs="*", default=list(parts))
    parser.add_argument("--num-seeds", type=int, default=3)
    args = parser.parse_args(argv)
    for part in args.part:
        rows = parts[part](args.num_seeds)
        io.write_csv(args.output / f"{part}.csv", list(rows[0]), rows)


if __name__ == "__main__":
    main()
