"""How much later one film started than another, by what both heard.

Two steps. The loudness of frequency bands over time, correlated over the whole films, finds the delay
to some milliseconds whatever the microphones and the room. Pieces of the waveforms, correlated around
it with a partly whitened spectrum, find it to a fraction of a sample, each for itself; a robust line
through their delays gives offset and clock rate. How far both stand out is the score.
"""

import dataclasses
import math

import numpy as np
import scipy.fft
import scipy.signal

from fourd.align.clock import PPM, PairDelay
from fourd.align.delay_line import MAX_RATE_PPM, Line, fit_line
from fourd.align.options import AlignOptions
from fourd.align.sound import BAND_RATE_HZ, HIGH_HZ, LOW_HZ, NUM_BANDS, RATE_HZ, Sound

# Exponent of the whitening: 1 is the phase transform, 0 plain correlation. From 0.7 on it makes no
# difference that can be measured, below it rooms suffer (benches/audio_sync.py, part `rooms`).
WHITENING = 0.9
MIN_OVERLAP_S = 0.4
NUM_CANDIDATES = 5
# Two peaks nearer than this are one: the sound's own likeness to itself, its echo.
PEAK_GAP_S = 0.15
MAX_WINDOWS = 120
MAX_WEIGHT = 100.0
MIN_WAVE_SHARE = 0.5
# Chance does not reach this height in a window.
SURE_WEIGHT = 12.0
# In a shorter film a pause cannot be told from two sounds that are alike.
MIN_PAUSE_WINDOWS, MIN_PART_WINDOWS = 10, 3
SEARCH_S = 0.06
BAND_TOLERANCE_S, WAVE_TOLERANCE_S = 0.02, 0.0015
BAND_SIGMA_S, WAVE_SIGMA_S = 4e-3, 1e-4
# A room moves the loudness of all windows alike, so that their agreement does not show it.
BAND_BIAS_S = 2e-3
# Odds that another lag up to MAX_LATE_S, 7 m of detour, is that of the direct sound go with the summed
# correlation to this power: 94 % of the errors in rooms are within two sigma (benches/audio_sync.py).
MAX_LATE_S, LAG_POWER = 0.02, 4
# Log-odds that a delay is right: constant, log prominence of the search, and for waveforms log height
# of the windows' sum and share of agreeing windows, for bands log height of the search. Fitted to 480
# recordings, half of them unrelated; on 240 others, score 0.5 accepts 2 of 120 unrelated ones and refuses
# 8 of 120 related ones (benches/audio_sync.py, part `score`).
WAVE_ODDS = (-8.4, 4.3, 1.1, 6.3)
BAND_ODDS = (-6.8, 3.6, 1.5)


@dataclasses.dataclass(frozen=True, eq=False)
class Windows:
    """Correlations of W windows: curves (W, 2 r + 1) at lags of 1 / rate_hz around center_s (W,).

    time_s: (W,) middle of the window, right film's clock;  delay_s: (W,) where the curve is highest
    weight: (W,) its height there in deviations of the curve, at most MAX_WEIGHT
    """

    time_s: np.ndarray
    center_s: np.ndarray
    delay_s: np.ndarray
    weight: np.ndarray
    curves: np.ndarray
    rate_hz: float


@dataclasses.dataclass(frozen=True, eq=False)
class SoundMatch:
    """A pair's delay and what speaks for it.

    search_s, search: (L,) delays and correlation of the bands over the whole films, in deviations
    windows, line: what was measured around the chosen delay, None where nothing could be compared
    is_wave: they are of waveforms, otherwise of bands
    evidence: log prominence and log height of the search, log height and agreeing share of the windows
    """

    delay: PairDelay
    search_s: np.ndarray
    search: np.ndarray
    windows: Windows | None = None
    line: Line | None = None
    is_wave: bool = False
    evidence: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


def estimate_audio_delay(
    left: Sound, right: Sound, names: tuple[str, str], options: AlignOptions
) -> SoundMatch:
    """Delay between two films, with its doubt and evidence.

    names: of the left and the right camera
    Returns a SoundMatch; its `delay.status` is a reason where no delay can be told, or none stands out.
    Source: Knapp and Carter 1976 for the phase transform; the rest is described in this module's head.
    """
    search_s, search = _search_bands(left, right, options.max_delay_s)
    if search.size == 0:
        why = f"no delay up to {options.max_delay_s:g} s lets their sound overlap by {MIN_OVERLAP_S:g} s"
        return SoundMatch(PairDelay(*names, 0.0, 0.0, 0.0, "audio", status=why), search_s, search)
    candidates = [
        _follow_peak(left, right, search_s, search, peak, names, options)
        for peak in _highest_peaks(search_s, search)
    ]
    best = max(candidates, key=lambda match: match.delay.score)
    # The next best first: the true delay of the other part, not its echo in music that repeats.
    others = sorted(candidates, key=lambda match: -match.delay.score)[1:]
    others += [
        _follow_peak(left, part, *search_part, peak, names, options)
        for part in _unmatched_parts(best, right)
        for search_part in (_search_bands(left, part, options.max_delay_s),)
        for peak in _highest_peaks(*search_part)
    ]
    pauses = (_describe_pause(best, other, options.window_s) for other in others)
    pause = next(filter(None, pauses), None)
    if pause is None:
        return best
    return dataclasses.replace(best, delay=dataclasses.replace(best.delay, score=0.0, status=pause))


def _unmatched_parts(match: SoundMatch, right: Sound) -> list[Sound]:
    """What the right film heard before and after the windows that fit the left one, if that is long.

    In music that repeats, the delay of such a part stands out only when it is searched by itself.
    """
    if match.windows is None or match.line is None or not match.is_wave:
        return []
    time_s = match.windows.time_s
    sure = np.flatnonzero(match.line.is_used & (match.windows.weight >= SURE_WEIGHT))
    if len(sure) < 3 or len(time_s) < MIN_PAUSE_WINDOWS:
        return []
    first, last = int(sure[0]), int(sure[-1])
    parts = []
    if first >= MIN_PART_WINDOWS:
        parts.append(right.cut(right.start_s, float(time_s[first])))
    if len(time_s) - 1 - last >= MIN_PART_WINDOWS:
        parts.append(right.cut(float(time_s[last]), right.end_s))
    return parts


def _describe_pause(best: SoundMatch, other: SoundMatch, window_s: float) -> str | None:
    """Why two delays are both right, each for its own part of the films; None if they are not."""
    if best.windows is None or len(best.windows.time_s) < MIN_PAUSE_WINDOWS:
        return None
    spans = []
    for match in (best, other):
        if match.windows is None or match.line is None or not match.is_wave:
            return None
        sure = match.line.is_used & (match.windows.weight >= SURE_WEIGHT)
        if sure.sum() < 3:
            return None
        spans.append((match.windows.time_s[sure], match.line))
    (first_s, first), (second_s, second) = sorted(spans, key=lambda span: float(span[0].mean()))
    # A window across the break holds a little of both.
    if first_s.max() >= second_s.min() + window_s:
        return None
    jump_s = float(second.at(second_s.min()) - first.at(first_s.max()))
    if abs(jump_s) <= PEAK_GAP_S:
        return None
    break_s = (first_s.max() + second_s.min()) / 2
    return (
        f"the delay of their sound jumps by {jump_s:+.2f} s about {break_s:.1f} s after the start of "
        f"{best.delay.right}: one of the two recordings was paused or cut"
    )


def _follow_peak(
    left: Sound,
    right: Sound,
    search_s: np.ndarray,
    search: np.ndarray,
    peak: int,
    names: tuple[str, str],
    options: AlignOptions,
) -> SoundMatch:
    """From one peak of the search to a line and a score."""
    start = Line(float(search_s[peak]))
    begin, end = overlap_of(left, right, start.delay_s)
    # Before the rate is known, the delay at the films' ends may lie that far from its mean.
    radius_s = SEARCH_S + MAX_RATE_PPM * PPM * (end - begin) / 2
    bands = _correlate_windows(left, right, start, 4 * options.window_s, radius_s, is_wave=False)
    band_line = fit_line(bands.time_s, bands.delay_s, bands.weight, BAND_TOLERANCE_S, BAND_SIGMA_S)
    waves = _correlate_windows(left, right, band_line, options.window_s, SEARCH_S, is_wave=True)
    wave_line = fit_line(waves.time_s, waves.delay_s, waves.weight**2, WAVE_TOLERANCE_S, WAVE_SIGMA_S)
    prominence = math.log(_prominence(search_s, search, peak))
    height = math.log(max(float(search[peak]), 0.1))
    lags_s, total = stack_windows(waves, wave_line)
    sum_height = math.log(max(float(total.max()), 0.1))
    share = float(waves.weight[wave_line.is_used].sum() / waves.weight.sum())
    wave_score = _probability(WAVE_ODDS, (prominence, sum_height, share))
    band_score = _probability(BAND_ODDS, (prominence, height))
    # Waveforms are by far the finer measure, but in a hall they may lock to a reflection.
    is_wave = share >= MIN_WAVE_SHARE
    line, score = (wave_line, wave_score) if is_wave else (band_line, band_score)
    bias_s = _spread_of_lags(lags_s, total) if is_wave else BAND_BIAS_S
    status = "ok"
    if score < options.min_sound_score:
        status = f"no delay stands out in their sound (score {score:.2f}, wanted {options.min_sound_score:g})"
    delay = PairDelay(
        *names,
        delay_s=float(line.at(0.0)),
        sigma_s=math.hypot(line.sigma_s, bias_s),
        score=score,
        method="audio",
        rate_ppm=line.rate_ppm,
        status=status,
        time_s=line.time_s,
        rate_sigma_ppm=line.rate_sigma_ppm,
    )
    windows = waves if is_wave else bands
    return SoundMatch(
        delay, search_s, search, windows, line, is_wave, (prominence, height, sum_height, share)
    )


def _probability(odds: tuple[float, ...], evidence: tuple[float, ...]) -> float:
    total = odds[0] + sum(factor * value for factor, value in zip(odds[1:], evidence, strict=True))
    return 1 / (1 + math.exp(-min(max(total, -30.0), 30.0)))


def overlap_of(left: Sound, right: Sound, delay_s: float) -> tuple[float, float]:
    """Begin and end of what both films heard, right film's clock, if left_s - right_s is delay_s."""
    return max(right.start_s, left.start_s - delay_s), min(right.end_s, left.end_s - delay_s)


def _search_bands(left: Sound, right: Sound, max_delay_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Delays (L,) and correlation (L,) of the bands over the films' whole overlap.

    The correlation coefficient times the root of the overlap's length, so that chance is equally high
    at every delay; in units of its median deviation.
    """
    counts = left.bands.shape[1], right.bands.shape[1]
    size = scipy.fft.next_fast_len(sum(counts), real=True)
    spectra = [np.fft.rfft(sound.bands, size, axis=1) for sound in (left, right)]
    energies = [
        np.fft.rfft((sound.bands.astype(np.float64) ** 2).sum(axis=0), size) for sound in (left, right)
    ]
    ones = [np.fft.rfft(np.ones(count), size) for count in counts]
    overlap = np.fft.irfft(ones[0] * np.conj(ones[1]), size)
    lags = np.arange(1 - counts[1], counts[0])
    delays = lags / BAND_RATE_HZ + left.start_s - right.start_s
    keep = (overlap[lags] > MIN_OVERLAP_S * BAND_RATE_HZ - 0.5) & (np.abs(delays) <= max_delay_s)
    lags, delays = lags[keep], delays[keep]
    if lags.size == 0:
        return delays, np.zeros(0)
    energy_left = np.fft.irfft(energies[0] * np.conj(ones[1]), size)[lags]
    energy_right = np.fft.irfft(ones[0] * np.conj(energies[1]), size)[lags]
    energy = np.sqrt(np.maximum(energy_left, 1e-6) * np.maximum(energy_right, 1e-6))
    products = np.fft.irfft((spectra[0] * np.conj(spectra[1])).sum(axis=0), size)[lags]
    values = products / energy * np.sqrt(NUM_BANDS * overlap[lags])
    values -= np.median(values)
    return delays, values / max(1.4826 * float(np.median(np.abs(values))), 1e-6)


def _highest_peaks(search_s: np.ndarray, search: np.ndarray) -> list[int]:
    """Indices of the highest points, each apart from the others by more than PEAK_GAP_S."""
    remaining = search.copy()
    peaks: list[int] = []
    while len(peaks) < NUM_CANDIDATES and np.isfinite(remaining.max()):
        peaks.append(int(np.argmax(remaining)))
        remaining[np.abs(search_s - search_s[peaks[-1]]) <= PEAK_GAP_S] = -np.inf
    return peaks


def _prominence(search_s: np.ndarray, search: np.ndarray, peak: int) -> float:
    """Height of a peak over the highest point that is no part of it, 0.1 to 10; chance gives 1."""
    others = search[np.abs(search_s - search_s[peak]) > PEAK_GAP_S]
    rival = max(float(others.max()), 1e-6) if others.size else 1e-6
    return min(max(float(search[peak]) / rival, 0.1), 10.0)


def _correlate_windows(
    left: Sound, right: Sound, line: Line, window_s: float, radius_s: float, is_wave: bool
) -> Windows:
    """Compare pieces of the right film with the left one around the delays that a line foretells.

    is_wave: waveforms with a partly whitened spectrum, otherwise bands
    """
    rate = float(RATE_HZ if is_wave else BAND_RATE_HZ)
    one, two = (sound.samples if is_wave else sound.bands for sound in (left, right))
    begin, end = overlap_of(left, right, float(line.at((right.start_s + right.end_s) / 2)))
    # At least five windows, so that they can agree or not.
    length_s = min(window_s, (end - begin) / 3)
    count = int(np.clip(math.ceil(2 * (end - begin) / length_s) - 1, 1, MAX_WINDOWS))
    size, radius = int(length_s * rate), int(radius_s * rate)
    firsts = np.round((np.linspace(begin, end - length_s, count) - right.start_s) * rate).astype(int)
    firsts = np.clip(firsts, 0, two.shape[1] - size)
    time_s = right.start_s + (firsts + size / 2) / rate
    shifts = np.round((line.at(time_s) + right.start_s - left.start_s) * rate).astype(int)
    num_fft = int(scipy.fft.next_fast_len(size + 2 * radius, real=True) or 0)
    taper = np.asarray(scipy.signal.get_window(("tukey", 0.2), size, fftbins=False), dtype=np.float32)
    curves = np.zeros((count, 2 * radius + 1), dtype=np.float32)
    for index, (first, shift) in enumerate(zip(firsts, shifts, strict=True)):
        heard = np.fft.rfft(_cut(one, first + shift - radius, size + 2 * radius), num_fft, axis=1)
        sought = np.fft.rfft(_cut(two, first, size) * taper, num_fft, axis=1)
        cross = (heard * np.conj(sought)).sum(axis=0)
        if is_wave:
            cross = _whiten(cross, num_fft)
        curve = np.fft.irfft(cross, num_fft)[: 2 * radius + 1]
        # A window of digital silence says nothing: its curve stays 0.
        deviation = 1.4826 * float(np.median(np.abs(curve)))
        if deviation > 1e-20:
            curves[index] = np.clip(curve / deviation, -MAX_WEIGHT, MAX_WEIGHT)
    peaks = np.argmax(curves, axis=1)
    center_s = left.start_s - right.start_s + shifts / rate
    delay_s = center_s + (peaks - radius + _refine_peaks(curves, peaks)) / rate
    weight = np.maximum(curves[np.arange(count), peaks], 1e-3).astype(np.float64)
    return Windows(time_s, center_s, delay_s, weight, curves, rate)


def _whiten(cross: np.ndarray, num_fft: int) -> np.ndarray:
    """Even out a cross spectrum between LOW_HZ and HIGH_HZ, so that its peak is narrow."""
    frequency = np.arange(len(cross)) * (RATE_HZ / num_fft)
    strength = np.abs(cross)
    floor = 1e-6 * float(strength.max()) + 1e-30
    flat = cross / np.maximum(strength, floor) ** WHITENING
    return np.where((frequency >= LOW_HZ) & (frequency <= HIGH_HZ), flat, 0)


def _cut(signal: np.ndarray, first: int, size: int) -> np.ndarray:
    """(B, size) from index `first` on, zero outside the signal (B, n)."""
    piece = np.zeros((signal.shape[0], size), dtype=np.float32)
    begin, end = max(first, 0), min(first + size, signal.shape[1])
    if end > begin:
        piece[:, begin - first : end - first] = signal[:, begin:end]
    return piece


def _refine_peaks(curves: np.ndarray, peaks: np.ndarray) -> np.ndarray:
    """(W,) vertex of the parabola through each peak and its neighbours, -0.5 to 0.5 lags."""
    inner = np.clip(peaks, 1, curves.shape[1] - 2)
    rows = np.arange(len(curves))
    before, middle, after = (curves[rows, inner + step].astype(np.float64) for step in (-1, 0, 1))
    bend = before - 2 * middle + after
    vertex = 0.5 * (before - after) / np.where(bend < 0, bend, -np.inf)
    return np.where(inner == peaks, np.clip(vertex, -0.5, 0.5), 0.0)


def _spread_of_lags(lags_s: np.ndarray, total: np.ndarray) -> float:
    """Doubt about the direct sound, s: how far from the line other lags are that could be it, too.

    Windows that all lock to the same reflection agree with each other; only the sum's other peaks tell.
    """
    lags_s, total = (values[np.abs(lags_s) <= MAX_LATE_S] for values in (lags_s, total))
    chance = (np.maximum(total, 0) / max(float(total.max()), 1e-12)) ** LAG_POWER
    return math.sqrt(float((chance * lags_s**2).sum()) / max(float(chance.sum()), 1e-12))


def stack_windows(windows: Windows, line: Line) -> tuple[np.ndarray, np.ndarray]:
    """Lags (K,) around a line, s, and the windows' curves added up along it, in deviations."""
    radius = windows.curves.shape[1] // 2
    moved = np.round((line.at(windows.time_s) - windows.center_s) * windows.rate_hz).astype(int)
    width = max(radius - int(np.abs(moved).max()), 1)
    moved = np.clip(moved, width - radius, radius - width)
    total = np.zeros(2 * width + 1)
    for curve, shift in zip(windows.curves, moved, strict=True):
        total += curve[radius + shift - width : radius + shift + width + 1]
    return np.arange(-width, width + 1) / windows.rate_hz, total / math.sqrt(len(windows.curves))
