"""A robust line through the delays of many windows: offset and clock rate of two films."""

import dataclasses
import math

import numpy as np

from fourd.align.clock import PPM

# Quartz clocks of phones stay within 100 ppm of the truth; two of them and some margin.
MAX_RATE_PPM = 400.0
# A rate is told when its own standard deviation is below; a film too short for that gets 0.
TOLD_RATE_PPM = 15.0
NUM_HEAVIEST = 40


@dataclasses.dataclass(frozen=True, eq=False)
class Line:
    """left_s - right_s against right_s, own times of one event: delay_s at time_s, changing by rate_ppm.

    sigma_s: standard deviation of delay_s;  rate_sigma_ppm: of the rate, None where it is not told
    is_used: (W,) which windows agree with the line
    """

    delay_s: float
    rate_ppm: float = 0.0
    time_s: float = 0.0
    sigma_s: float = 0.0
    rate_sigma_ppm: float | None = None
    is_used: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, dtype=bool))

    def at(self, right_s: np.ndarray | float) -> np.ndarray:
        """Delay at times of the right film's clock, s."""
        return self.delay_s + self.rate_ppm * PPM * (np.asarray(right_s, dtype=np.float64) - self.time_s)


def fit_line(
    time_s: np.ndarray, delay_s: np.ndarray, weight: np.ndarray, tolerance_s: float, sigma_s: float
) -> Line:
    """The line that most windows agree with, then robust least squares over those.

    time_s, delay_s, weight: (W,), weight > 0;  tolerance_s: how far an agreeing window may lie from it
    sigma_s: scatter that is expected of one window; what is measured takes over as windows add up
    """
    heavy = np.argsort(-weight, kind="stable")[:NUM_HEAVIEST]
    one, two = (heavy[index] for index in np.triu_indices(len(heavy), 1))
    apart = np.abs(time_s[two] - time_s[one]) > 1e-6
    one, two = one[apart], two[apart]
    rates = (delay_s[two] - delay_s[one]) / (time_s[two] - time_s[one])
    is_slow = np.abs(rates) <= MAX_RATE_PPM * PPM
    anchors = np.concatenate([heavy, one[is_slow]])
    rates = np.concatenate([np.zeros(len(heavy)), rates[is_slow]])
    errors = delay_s - (delay_s[anchors, None] + rates[:, None] * (time_s - time_s[anchors, None]))
    closeness = np.maximum(1 - (errors / tolerance_s) ** 2, 0)
    best = closeness[int(np.argmax((closeness * weight).sum(axis=1)))]
    return _least_squares(time_s, delay_s, weight, best > 0, sigma_s)


def _least_squares(
    time_s: np.ndarray, delay_s: np.ndarray, weight: np.ndarray, is_used: np.ndarray, sigma_s: float
) -> Line:
    """Weighted line through the used windows, with a rate where it can be told."""
    time, delay = time_s[is_used], delay_s[is_used]
    # No window counts for much more than the others; neighbours overlap, so two are worth one and a bit.
    share = np.minimum(weight[is_used], 3 * np.median(weight[is_used]))
    share = share / share.sum()
    count = 1 / float((share**2).sum()) / (1.5 if len(time) > 1 else 1.0)
    middle = float((share * time).sum())
    spread = math.sqrt(float((share * (time - middle) ** 2).sum()))
    for has_rate in (True, False):
        rate, mean = _huber_line(time - middle, delay, share, has_rate, 0.1 * sigma_s)
        squares = (delay - mean - rate * (time - middle)) ** 2
        square = float((share * np.minimum(squares, 9 * np.median(squares))).sum())
        degrees = max(count - 1 - has_rate, 0)
        scatter = math.sqrt((square * count + 2 * sigma_s**2) / (degrees + 2))
        sigma = scatter / math.sqrt(max(count, 1.0))
        rate_sigma_ppm = sigma / max(spread, 1e-9) / PPM
        if has_rate and rate_sigma_ppm <= TOLD_RATE_PPM:
            return Line(mean, rate / PPM, middle, sigma, rate_sigma_ppm, is_used)
    return Line(mean, 0.0, middle, sigma, None, is_used)


def _huber_line(
    time: np.ndarray, delay: np.ndarray, share: np.ndarray, has_rate: bool, floor_s: float
) -> tuple[float, float]:
    """Slope and value at time 0 of the line that large errors pull no more than moderate ones."""
    weight, rate, mean = share, 0.0, 0.0
    for _ in range(8):
        middle = float((weight * time).sum() / weight.sum())
        level = float((weight * delay).sum() / weight.sum())
        spread = float((weight * (time - middle) ** 2).sum())
        if has_rate and spread > 0:
            rate = float((weight * (time - middle) * (delay - level)).sum()) / spread
        mean = level - rate * middle
        errors = np.abs(delay - mean - rate * time)
        limit = 2 * max(1.4826 * float(np.median(errors)), floor_s)
        weight = share * np.minimum(1, limit / np.maximum(errors, 1e-15))
    return rate, mean
