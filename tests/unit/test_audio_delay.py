import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.align.audio_delay import SoundMatch, estimate_audio_delay, stack_windows
from fourd.align.clock import PPM
from fourd.align.delay_line import TOLD_RATE_PPM, fit_line
from fourd.align.options import AlignOptions
from fourd.align.sound import check_sound, prepare_sound

HZ = 16_000
OPTIONS = AlignOptions()


def crowd(seed: int, duration_s: float) -> np.ndarray:
    """Noise that swells and falls, HZ."""
    rng = np.random.default_rng(seed)
    count = int(duration_s * HZ)
    knots = np.arange(0, count + 4000, 4000)
    swell = np.interp(np.arange(count), knots, rng.uniform(0.1, 1, len(knots)))
    return 0.1 * swell * rng.standard_normal(count)


def hear(event: np.ndarray, first_s: float, duration_s: float, seed: int, noise: float = 0.02) -> np.ndarray:
    """A piece of the event from first_s on, with the phone's own noise."""
    first = round(first_s * HZ)
    piece = event[first : first + int(duration_s * HZ)]
    return (piece + noise * np.random.default_rng([seed, 1]).standard_normal(len(piece))).astype(np.float32)


def measure(left: np.ndarray, right: np.ndarray, **starts: float) -> SoundMatch:
    return estimate_audio_delay(
        prepare_sound(left, HZ, starts.get("left_s", 0.0)),
        prepare_sound(right, HZ, starts.get("right_s", 0.0)),
        ("left", "right"),
        OPTIONS,
    )


def test_convention_delay_is_offset_of_right_minus_offset_of_left() -> None:
    event = crowd(1, 12)
    # The right film starts 1.5 s later on the common clock.
    delay = measure(hear(event, 1.0, 8, 2), hear(event, 2.5, 8, 3)).delay
    assert delay.status == "ok"
    assert delay.delay_s == pytest.approx(1.5, abs=1e-4)
    # An event at left_s is heard at right_s = left_s - delay_s.
    swapped = measure(hear(event, 2.5, 8, 3), hear(event, 1.0, 8, 2)).delay
    assert swapped.delay_s == pytest.approx(-1.5, abs=1e-4)


def test_start_of_the_sound_on_the_films_clock_counts() -> None:
    event = crowd(1, 12)
    delay = measure(hear(event, 1.0, 8, 2), hear(event, 1.0, 8, 3), left_s=0.25, right_s=-0.5).delay
    assert delay.delay_s == pytest.approx(0.75, abs=1e-4)


@settings(max_examples=8, deadline=None)
@given(st.floats(-3, 3), st.integers(0, 1000))
def test_any_delay_is_found_to_a_fraction_of_a_sample(delay_s: float, seed: int) -> None:
    event = crowd(seed, 12)
    spectrum = np.fft.rfft(event)
    phase = 2j * np.pi * np.fft.rfftfreq(len(event), 1 / HZ)
    later = np.fft.irfft(spectrum * np.exp(phase * delay_s), len(event))
    delay = measure(hear(event, 3.5, 5, 2), hear(later, 3.5, 5, 3)).delay
    assert delay.status == "ok"
    assert delay.delay_s == pytest.approx(delay_s, abs=0.3 / HZ)


def test_rate_is_told_over_a_minute_and_not_over_two_seconds() -> None:
    event = crowd(4, 66)
    own_s = np.arange(60 * HZ) / HZ
    rate_ppm = 120.0
    # common = 2 + (1 + rate) own
    right = np.interp(2 + (1 + rate_ppm * PPM) * own_s, np.arange(len(event)) / HZ, event)
    delay = measure(hear(event, 0, 60, 1), hear(right, 0, 60, 2)).delay
    assert delay.rate_sigma_ppm is not None
    assert delay.rate_ppm == pytest.approx(rate_ppm, abs=1)
    assert delay.delay_s == pytest.approx(2, abs=1e-4)
    short = measure(hear(event, 0, 2, 1), hear(right, 0, 2, 2)).delay
    assert short.rate_ppm == 0.0 and short.rate_sigma_ppm is None


def unlike_microphone(samples: np.ndarray) -> np.ndarray:
    gains = 10 ** (np.random.default_rng(7).uniform(-10, 10, 12) / 20)
    response = scipy.signal.firwin2(255, np.linspace(0, 1, 12), gains)
    return np.asarray(scipy.signal.lfilter(response, 1, samples))[127:]


def clip(samples: np.ndarray) -> np.ndarray:
    return np.clip(0.3 * samples, -0.03, 0.03)


def mute(samples: np.ndarray) -> np.ndarray:
    muted = samples.copy()
    muted[: len(muted) // 2] = 0
    return muted


def reverberate(samples: np.ndarray) -> np.ndarray:
    echo = np.random.default_rng(8).standard_normal(HZ // 2) * 10 ** (-3 * np.arange(HZ // 2) / (HZ // 2))
    echo *= 1.2 / np.linalg.norm(echo)
    echo[0] = 1
    return scipy.signal.fftconvolve(samples, echo)[: len(samples)]


@pytest.mark.parametrize("spoil", [unlike_microphone, clip, mute, reverberate])
def test_spoiled_recordings_are_still_placed(spoil: Callable[[np.ndarray], np.ndarray]) -> None:
    event = crowd(1, 16)
    delay = measure(hear(event, 1.0, 12, 2), spoil(hear(event, 2.5, 12, 3)).astype(np.float32)).delay
    assert delay.status == "ok"
    assert delay.delay_s == pytest.approx(1.5, abs=1e-3)


def test_sample_rates_may_differ() -> None:
    event = crowd(1, 12)
    right = scipy.signal.resample_poly(hear(event, 2.5, 8, 3), 441, 160).astype(np.float32)
    match = estimate_audio_delay(
        prepare_sound(hear(event, 1.0, 8, 2), HZ), prepare_sound(right, 44_100), ("left", "right"), OPTIONS
    )
    assert match.delay.delay_s == pytest.approx(1.5, abs=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_unrelated_sounds_are_refused(seed: int) -> None:
    delay = measure(hear(crowd(seed, 10), 0, 10, 1), hear(crowd(seed + 100, 10), 0, 10, 2)).delay
    assert delay.status != "ok" and "no delay stands out" in delay.status
    assert delay.score < 0.3


def test_films_that_do_not_overlap_are_refused() -> None:
    event = crowd(1, 30)
    assert measure(hear(event, 0, 10, 1), hear(event, 15, 10, 2)).delay.status != "ok"
    near = dataclasses.replace(OPTIONS, max_delay_s=0.1)
    far = estimate_audio_delay(
        prepare_sound(hear(event, 0, 2, 1), HZ, -60.0),
        prepare_sound(hear(event, 0, 2, 1), HZ),
        ("l", "r"),
        near,
    )
    assert "overlap" in far.delay.status


def test_a_paused_recording_is_named() -> None:
    event = crowd(1, 32)
    left = hear(event, 1.0, 24, 2)
    right = np.concatenate([hear(event, 2.0, 10, 3), hear(event, 14.0, 10, 4)])
    delay = measure(left, right).delay
    assert "paused" in delay.status and "2.00 s" in delay.status
    assert delay.score == 0


def test_a_pause_in_music_that_repeats_is_named() -> None:
    """The loudness of bars repeats, which outweighs the shorter part's own delay over the whole films."""
    beat = np.interp(np.arange(2 * HZ), np.arange(0, 2 * HZ, 2000), [1, 0, 0.3, 0, 0.9, 0.2, 0, 0.6] * 2)
    drums = 0.1 * np.tile(beat, 16) * np.random.default_rng(5).standard_normal(32 * HZ)
    event = drums + 0.8 * crowd(1, 32)
    left = hear(event, 1.0, 24, 2)
    right = np.concatenate([hear(event, 2.0, 8, 3), hear(event, 11.3, 12, 4)])
    delay = measure(left, right).delay
    assert "paused" in delay.status and "1.30 s" in delay.status


def test_doubt_covers_a_reflection_that_is_louder_than_the_direct_sound() -> None:
    """What was heard 8 ms late is the highest peak; nothing in the sum says that it is the wrong one."""
    event = crowd(1, 16)
    late = np.concatenate([np.zeros(128), event[:-128]])
    delay = measure(hear(event, 1.0, 12, 2), hear(event + 1.3 * late, 2.5, 12, 3)).delay
    error_s = delay.delay_s - 1.5
    assert abs(error_s) == pytest.approx(0.008, abs=1e-4)
    assert abs(error_s) < 2 * delay.sigma_s
    plain = measure(hear(event, 1.0, 12, 2), hear(event, 2.5, 12, 3)).delay
    assert plain.sigma_s < 1e-4


def test_sum_of_windows_peaks_on_the_line() -> None:
    event = crowd(1, 12)
    match = measure(hear(event, 1.0, 8, 2), hear(event, 2.5, 8, 3))
    assert match.windows is not None and match.line is not None
    lags_s, total = stack_windows(match.windows, match.line)
    assert abs(lags_s[np.argmax(total)]) <= 1 / HZ


def test_line_ignores_windows_that_do_not_agree() -> None:
    rng = np.random.default_rng(0)
    time_s = np.linspace(0, 60, 50)
    delay_s = 0.4 + 80 * PPM * time_s + 2e-5 * rng.standard_normal(50)
    delay_s[::3] = rng.uniform(0.3, 0.5, len(delay_s[::3]))
    line = fit_line(time_s, delay_s, np.ones(50), 1.5e-3, 1e-4)
    assert line.rate_ppm == pytest.approx(80, abs=1)
    assert float(line.at(0.0)) == pytest.approx(0.4, abs=3e-5)
    assert line.rate_sigma_ppm is not None and line.rate_sigma_ppm < TOLD_RATE_PPM
    assert line.is_used.sum() <= 34


@pytest.mark.parametrize(
    ("samples", "reason"),
    [
        (np.zeros(HZ, dtype=np.float32), "silent"),
        (np.full(HZ, 0.3, dtype=np.float32), "silent"),
        (np.ones(HZ // 10, dtype=np.float32), "lasts 0.10 s"),
        (np.sign(np.random.default_rng(0).standard_normal(HZ)), "clipped"),
        (np.full(HZ, np.nan), "not numbers"),
    ],
)
def test_useless_sound_has_a_reason(samples: np.ndarray, reason: str) -> None:
    assert reason in check_sound(samples, HZ)


def test_good_sound_is_ok() -> None:
    assert check_sound(hear(crowd(1, 2), 0, 2, 1), HZ) == "ok"
