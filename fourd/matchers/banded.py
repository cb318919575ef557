"""Semi-global matching within two narrow bands of disparities at every pixel.

A coarser level says where to look: one band around its own answer, one around that of the nearest other
surface. Compared are colours and the order of grey levels; where the picture changes, disparity may jump
at a lower price, so that surfaces end where their colour does. Where surfaces meet, the order is that of
the nearest neighbours alone: a wide window shows both surfaces and follows the nearer one.

Disparity d of pixel x belongs to column x - d of the other image. Other rows are stored mirrored, so that
a band is a run of neighbouring values, which the compiler turns into vector code: that is why the
arithmetic below is cast to 16 or 32 bits at every step.

Source: M. Rothermel, K. Wenzel, D. Fritsch, N. Haala, "SURE: Photogrammetric surface reconstruction from
imagery", LC3D 2012, for the bands; H. Hirschmueller, PAMI 2008, for paths and penalties; S. Birchfield,
C. Tomasi, PAMI 1998, for the comparison of colours.
"""

import numba
import numpy as np

BAND_PX = 16
NUM_BANDS = 2
_CENSUS_BIT, _NEAREST_BIT = np.int16(4), np.int16(8)
"""Cost of a neighbour whose order differs, in grey levels summed over the channels, and where only the
nearest neighbours count."""
_ALL, _NEAREST = np.uint32(2**25 - 1), np.uint32(0b00000_01110_01110_01110_00000)
"""Bits of a census over 5x5 px, row by row, and those of its inner 3x3 px."""
_SMALL = np.int16(64)
"""Penalty of a step of 1 px between neighbours, in the same units."""
_LARGE_AT_EDGES, _EDGE_LEVELS = 96.0, 48.0
"""Lower bound of the penalty of any larger step, and the difference of colours, summed over the channels,
that halves it."""
_UNIQUENESS_PERCENT = 5
_MARGIN = BAND_PX + 2
"""Bands this far apart have no step of 1 px in common."""
_FAR = np.int16(16000)
_i16 = np.int16
_u32 = np.uint32


@numba.njit(cache=True, nogil=True, error_model="numpy")
def band_costs(
    ours: np.ndarray,
    theirs: np.ndarray,
    our_census: np.ndarray,
    their_census: np.ndarray,
    is_step: np.ndarray,
    first: np.ndarray,
    reach: int,
) -> np.ndarray:
    """How unlike pixel and match are at every disparity of every band.

    ours, theirs: (H, C, W) int16 channels of both images;  *_census: (H, W) uint32 of 5x5 px
    is_step: (H, W) bool, pixels of which only the nearest neighbours are compared
    first: (H, W, B) int16 lowest disparity of each band, px;  reach: bound of |disparity| in any band, px
    Returns (H, W, B, BAND_PX) int16; borders of the other image repeat
    """
    height, channels, width = ours.shape
    num_bands = first.shape[2]
    costs = np.zeros((height, width, num_bands, BAND_PX), np.int16)
    there = np.empty((3, width + 2 * reach), np.int16)
    order = np.empty(width + 2 * reach, np.uint32)
    for y in range(height):
        low, high = _half_pixel_range(ours[y])
        their_low, their_high = _half_pixel_range(theirs[y])
        for c in range(channels):
            _mirror(theirs[y, c], reach, there[0])
            _mirror(their_low[c], reach, there[1])
            _mirror(their_high[c], reach, there[2])
            _compare_colours(
                ours[y, c], low[c], high[c], there[0], there[1], there[2], first[y], reach, costs[y]
            )
        _mirror(their_census[y], reach, order)
        _compare_order(our_census[y], order, is_step[y], first[y], reach, costs[y])
    return costs


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _half_pixel_range(channels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value within half a pixel, between neighbours on a line; (C, W) int16 each."""
    low, high = channels.copy(), channels.copy()
    count, width = channels.shape
    for c in range(count):
        for x in range(width):
            here = channels[c, x]
            before = _i16((channels[c, max(x - 1, 0)] + here) >> 1)
            after = _i16((channels[c, min(x + 1, width - 1)] + here) >> 1)
            low[c, x] = min(min(before, after), here)
            high[c, x] = max(max(before, after), here)
    return low, high


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mirror(row: np.ndarray, reach: int, mirrored: np.ndarray) -> None:
    """A row from right to left, its ends repeated `reach` times."""
    last = row.size - 1
    for i in range(mirrored.size):
        mirrored[i] = row[min(max(last + reach - i, 0), last)]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _compare_colours(
    here: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    there: np.ndarray,
    there_low: np.ndarray,
    there_high: np.ndarray,
    first: np.ndarray,
    reach: int,
    costs: np.ndarray,
) -> None:
    """One channel of a row, added to its costs (W, B, BAND_PX)."""
    for x in range(here.size):
        for band in range(first.shape[1]):
            start = reach + here.size - 1 - x + np.int64(first[x, band])
            at = slice(start, start + BAND_PX)
            _add_colours(here[x], low[x], high[x], there[at], there_low[at], there_high[at], costs[x, band])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _compare_order(
    here: np.ndarray,
    there: np.ndarray,
    is_step: np.ndarray,
    first: np.ndarray,
    reach: int,
    costs: np.ndarray,
) -> None:
    """Census transforms of a row, added to its costs."""
    for x in range(here.size):
        counted, price = (_NEAREST, _NEAREST_BIT) if is_step[x] else (_ALL, _CENSUS_BIT)
        for band in range(first.shape[1]):
            start = reach + here.size - 1 - x + np.int64(first[x, band])
            _add_order(here[x], there[start : start + BAND_PX], counted, price, costs[x, band])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_colours(
    here: np.int16,
    low: np.int16,
    high: np.int16,
    there: np.ndarray,
    there_low: np.ndarray,
    there_high: np.ndarray,
    costs: np.ndarray,
) -> None:
    """Difference of a channel that half a pixel of shift does not explain."""
    for d in range(BAND_PX):
        ours = max(_i16(here - there_high[d]), _i16(there_low[d] - here))
        theirs = max(_i16(there[d] - high), _i16(low - there[d]))
        costs[d] = _i16(costs[d] + max(_i16(0), min(ours, theirs)))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add_order(
    here: np.uint32, there: np.ndarray, counted: np.uint32, price: np.int16, costs: np.ndarray
) -> None:
    """Price of the bits that differ, which are counted in pairs, fours and bytes."""
    for d in range(BAND_PX):
        bits = _u32(_u32(here ^ there[d]) & counted)
        bits = _u32(bits - _u32(_u32(bits >> _u32(1)) & _u32(0x55555555)))
        bits = _u32(_u32(bits & _u32(0x33333333)) + _u32(_u32(bits >> _u32(2)) & _u32(0x33333333)))
        bits = _u32(_u32(bits + _u32(bits >> _u32(4))) & _u32(0x0F0F0F0F))
        count = _i16(_u32(_u32(bits * _u32(0x01010101)) >> _u32(24)))
        costs[d] = _i16(costs[d] + _i16(count * price))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def jump_penalties(image: np.ndarray, large: float, directions: int) -> np.ndarray:
    """(directions, H, W) int16: price of a jump between each pixel and its neighbours.

    image: (H, W, C) uint8;  large: price between pixels of one colour
    directions: 2, the neighbour on the left and that above, or 4, those above to the left and right too
    Where there is no such neighbour, 0
    """
    height, width, channels = image.shape
    price = np.empty(channels * 255 + 1, np.int16)
    for difference in range(price.size):
        price[difference] = _i16(max(large / (1 + difference / _EDGE_LEVELS), _LARGE_AT_EDGES))
    penalties = np.zeros((directions, height, width), np.int16)
    for direction in range(directions):
        up = 0 if direction == 0 else 1
        aside = (-1, 0, -1, 1)[direction]
        for y in range(up, height):
            for x in range(max(-aside, 0), width - max(aside, 0)):
                difference = 0
                for c in range(channels):
                    here, there = np.int64(image[y, x, c]), np.int64(image[y - up, x + aside, c])
                    difference += abs(here - there)
                penalties[direction, y, x] = price[difference]
    return penalties


@numba.njit(cache=True, nogil=True, error_model="numpy")
def aggregate_bands(costs: np.ndarray, first: np.ndarray, penalties: np.ndarray) -> np.ndarray:
    """Costs summed along four paths that end in each pixel: from the left, right, above and below.

    costs: of `band_costs`;  first: its bands;  penalties: of `jump_penalties`
    Returns (H, W, 2, BAND_PX) int16
    """
    height, width = first.shape[:2]
    total = np.zeros(costs.shape, np.int16)
    # A margin on both sides of a band, so that bands of neighbours may lie apart.
    line = np.empty((2, NUM_BANDS, BAND_PX + 2 * _MARGIN), np.int16)
    rows = np.empty((2, width, NUM_BANDS, BAND_PX + 2 * _MARGIN), np.int16)
    least = np.empty(width, np.int16)
    nothing = np.zeros(width, np.int16)
    for forward in (True, False):
        rows[:] = _FAR
        least[:] = 0
        for i in range(height):
            y = i if forward else height - 1 - i
            before = y if i == 0 else (y - 1 if forward else y + 1)
            price = nothing if i == 0 else penalties[1, max(y, before)]
            a = i % 2
            _path_down(rows[a], first[before], costs[y], first[y], price, least, rows[1 - a], total[y])
            _path_along(forward, costs[y], first[y], penalties[0, y], line, total[y])
    return total


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _path_down(
    before: np.ndarray,
    first_before: np.ndarray,
    costs: np.ndarray,
    first: np.ndarray,
    price: np.ndarray,
    least: np.ndarray,
    path: np.ndarray,
    total: np.ndarray,
) -> None:
    """A row of vertical paths, from the row before to `path`, and added to `total`; updates `least`."""
    for x in range(first.shape[0]):
        lowest = least[x]
        jump = _i16(lowest + price[x])
        least[x] = _step(before[x], first_before[x], costs[x], first[x], jump, lowest, path[x], total[x])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _path_along(
    forward: bool,
    costs: np.ndarray,
    first: np.ndarray,
    price: np.ndarray,
    line: np.ndarray,
    total: np.ndarray,
) -> None:
    """A path along a row, added to `total`."""
    width = first.shape[0]
    line[:] = _FAR
    lowest = _i16(0)
    for i in range(width):
        x = i if forward else width - 1 - i
        before = x if i == 0 else (x - 1 if forward else x + 1)
        jump = _i16(lowest + price[max(x, before)]) if i > 0 else _i16(0)
        here, there = i % 2, (i + 1) % 2
        lowest = _step(line[here], first[before], costs[x], first[x], jump, lowest, line[there], total[x])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _step(
    before: np.ndarray,
    first_before: np.ndarray,
    costs: np.ndarray,
    first: np.ndarray,
    jump: np.int16,
    lowest: np.int16,
    path: np.ndarray,
    total: np.ndarray,
) -> np.int16:
    """One pixel of a path after the one before it, to `path` and added to `total`. Returns its least cost."""
    least = _i16(32000)
    for band in range(NUM_BANDS):
        one = before[0, _around(first[band], first_before[0])]
        other = before[1, _around(first[band], first_before[1])]
        for d in range(BAND_PX):
            lower = min(one[d], other[d])
            same = min(one[d + 1], other[d + 1])
            higher = min(one[d + 2], other[d + 2])
            best = min(min(same, jump), _i16(min(lower, higher) + _SMALL))
            value = _i16(costs[band, d] + _i16(best - lowest))
            path[band, _MARGIN + d] = value
            total[band, d] = _i16(total[band, d] + value)
            least = min(least, value)
    return least


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _around(first: np.int16, first_before: np.int16) -> slice:
    """A band and one more at both ends, in the stored one of a neighbour; bands apart meet in the margin."""
    apart = np.int64(first) - np.int64(first_before)
    start = _MARGIN - 1 + min(max(apart, 1 - _MARGIN), _MARGIN - 1)
    return slice(start, start + BAND_PX + 2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def best_in_bands(total: np.ndarray, first: np.ndarray) -> np.ndarray:
    """(H, W) float32 disparity of the least cost, px, where two straight lines through three costs meet.

    NaN where it lies at an end of its band, or where another one is nearly as good.
    """
    height, width = first.shape[:2]
    best = np.full((height, width), np.float32(np.nan), np.float32)
    for y in range(height):
        for x in range(width):
            at = total[y, x]
            least = _i16(32000)
            for band in range(NUM_BANDS):
                for d in range(BAND_PX):
                    least = min(least, at[band, d])
            found, place = 0, 0
            for band in range(NUM_BANDS):
                for d in range(1, BAND_PX - 1):
                    if at[band, d] == least and place == 0:
                        found, place = band, d
            if place == 0:
                continue
            disparity = np.int64(first[y, x, found]) + place
            bound = _i16(np.int32(least) * (100 + _UNIQUENESS_PERCENT) // 100)
            rivals = 0
            for band in range(NUM_BANDS):
                apart = np.int64(first[y, x, band]) - disparity
                for d in range(BAND_PX):
                    rivals += (at[band, d] <= bound) & (abs(apart + d) > 1)
            if rivals == 0:
                below, above = np.float32(at[found, place - 1]), np.float32(at[found, place + 1])
                rise = 2 * (max(below, above) - np.float32(least))
                best[y, x] = disparity + ((below - above) / rise if rise > 0 else np.float32(0))
    return best
