"""A film's sound, made ready to be compared with another: resampled waveform and loudness of bands."""

import dataclasses
import math

import numpy as np
import scipy.ndimage
import scipy.signal

RATE_HZ = 16_000
# Bands are measured over 32 ms every 8 ms: fine enough to hand over to the waveforms.
FRAME, HOP = 512, 128
BAND_RATE_HZ = RATE_HZ / HOP
# Below is wind and handling noise, above is what microphones and codecs disagree on.
LOW_HZ, HIGH_HZ = 120.0, 7200.0
NUM_BANDS = 20
MEDIAN_FRAMES = 63
MIN_DURATION_S = 0.5
# Full scale is 1; a 16-bit recorder's last bit is 3e-5.
MIN_RMS = 5e-5
MAX_CLIPPED = 0.5
_BLOCK = 4096


@dataclasses.dataclass(frozen=True, eq=False)
class Sound:
    """samples: (1, n) float32 at RATE_HZ;  bands: (NUM_BANDS, m) float32 at BAND_RATE_HZ, unit variance

    start_s: time of the first sample on the camera's own clock
    """

    samples: np.ndarray
    bands: np.ndarray
    start_s: float

    @property
    def end_s(self) -> float:
        """Time of the end on the camera's own clock."""
        return self.start_s + self.samples.shape[1] / RATE_HZ

    def cut(self, begin_s: float, end_s: float) -> "Sound":
        """The piece between two times on the camera's own clock, begun at a whole hop of the bands."""
        first = max(math.floor((begin_s - self.start_s) * BAND_RATE_HZ), 0)
        last = math.floor((end_s - self.start_s) * BAND_RATE_HZ)
        samples = self.samples[:, first * HOP : last * HOP]
        num_frames = max((samples.shape[1] - FRAME) // HOP + 1, 0)
        return Sound(samples, self.bands[:, first : first + num_frames], self.start_s + first / BAND_RATE_HZ)


def check_sound(samples: np.ndarray, sample_rate: float) -> str:
    """`ok`, or the reason why a film's sound cannot be compared.

    samples: (n,) float in [-1, 1];  sample_rate: Hz
    """
    duration_s = len(samples) / sample_rate
    if duration_s < MIN_DURATION_S:
        return f"its sound lasts {duration_s:.2f} s, less than {MIN_DURATION_S:g} s"
    if not np.isfinite(samples).all():
        return "its sound holds values that are not numbers"
    spread = float(np.std(samples, dtype=np.float64))
    if spread < MIN_RMS:
        return f"its sound is silent (rms {spread:.1g} of full scale)"
    extreme = float(np.abs(samples).max())
    clipped = float(np.mean(np.abs(samples) >= 0.999 * extreme))
    if clipped > MAX_CLIPPED:
        return f"its sound is clipped all over ({clipped:.0%} of the samples are at the limit)"
    return "ok"


def prepare_sound(samples: np.ndarray, sample_rate: float, start_s: float = 0.0) -> Sound:
    """Resample a film's sound and measure its bands.

    samples: (n,) float in [-1, 1], checked by `check_sound`;  sample_rate: Hz
    start_s: time of the first sample on the camera's own clock
    """
    rate = round(sample_rate)
    common = math.gcd(RATE_HZ, rate)
    mono = np.asarray(samples, dtype=np.float32)
    if rate != RATE_HZ:
        mono = scipy.signal.resample_poly(mono, RATE_HZ // common, rate // common).astype(np.float32)
    mono = mono - np.float32(mono.mean(dtype=np.float64))
    return Sound(mono[None], _measure_bands(mono), start_s)


def _measure_bands(mono: np.ndarray) -> np.ndarray:
    """(NUM_BANDS, m) log energy against its own median over half a second, unit variance."""
    edges = np.round(np.geomspace(LOW_HZ, HIGH_HZ, NUM_BANDS + 1) * FRAME / RATE_HZ).astype(int)
    edges = np.maximum(edges, edges[0] + np.arange(NUM_BANDS + 1))
    frames = np.lib.stride_tricks.sliding_window_view(mono, FRAME)[::HOP]
    taper = np.hanning(FRAME).astype(np.float32)
    energy = np.empty((NUM_BANDS, len(frames)), dtype=np.float32)
    for first in range(0, len(frames), _BLOCK):
        block = np.fft.rfft(frames[first : first + _BLOCK] * taper, axis=1)
        power = block.real**2 + block.imag**2
        energy[:, first : first + _BLOCK] = np.add.reduceat(power[:, : edges[-1]], edges[:-1], axis=1).T
    # The floor keeps silence from outweighing what is heard.
    level = np.log(energy + energy.mean(axis=1, keepdims=True) * 1e-3 + 1e-20)
    # A median follows a step (a gain control, a pause) at once, so that only what is brief remains.
    level = level - np.stack([scipy.ndimage.median_filter(row, MEDIAN_FRAMES) for row in level])
    spread = level.std(axis=1, keepdims=True)
    return np.clip(level / np.where(spread > 1e-6, spread, np.inf), -4, 4).astype(np.float32)
