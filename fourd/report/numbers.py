"""Numbers as people read them, and as JSON can hold them."""

import math

_UNITS = ("B", "kB", "MB", "GB", "TB")


def finite(value: float | None) -> float | None:
    """The value as JSON can hold it: None for what is missing, not a number or infinite."""
    return None if value is None or not math.isfinite(value) else float(value)


def parse(text: str | None) -> float | None:
    """A number of a table; None for an empty cell or a word (`-`, `NA`)."""
    try:
        return float(text) if text else None
    except ValueError:
        return None


def show(value: float | None, digits: int = 3) -> str:
    """About `digits` significant digits, never in exponents within 1e-4 and 1e7; a dash for None."""
    if value is None:
        return "-"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if value == 0:
        return "0"
    size = abs(value)
    if size < 1e-4 or size >= 1e7:
        return f"{value:.{digits - 1}e}"
    whole = len(str(int(size))) if size >= 1 else 0
    leading_zeros = max(0, -math.floor(math.log10(size)) - 1) if size < 1 else 0
    return f"{value:.{min(6, max(0, digits - whole + leading_zeros))}f}"


def show_seconds(value: float | None) -> str:
    """12.3 s, 4 min 5 s, 2 h 3 min."""
    if value is None:
        return "-"
    if value < 60:
        return f"{value:.1f} s"
    minutes, seconds = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {seconds} s"


def show_bytes(value: float | None) -> str:
    """With the largest decimal unit that leaves at least 1."""
    if value is None:
        return "-"
    power = 0
    while value >= 1000 and power + 1 < len(_UNITS):
        value /= 1000
        power += 1
    return f"{value:.0f} {_UNITS[power]}" if power == 0 or value >= 100 else f"{value:.1f} {_UNITS[power]}"


def plural(count: int, word: str) -> str:
    """`1 camera`, `2 cameras`."""
    return f"{count} {word}" if count == 1 else f"{count} {word}s"
