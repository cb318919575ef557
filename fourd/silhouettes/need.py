"""Whether silhouettes are needed: where stereo matches enough, they are not made."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fourd.errors import InputError
from fourd.silhouettes.options import USES, SilhouetteOptions
from fourd.stereo.pairs import read_pair_meta


def read_pair_statuses(paths: Sequence[Path]) -> dict[tuple[str, str], str]:
    """(left, right) -> status, of rectification files. Raises InputError for another file."""
    metas = map(read_pair_meta, paths)
    return {(meta["left"], meta["right"]): meta["status"] for meta in metas}


def reason_against(
    statuses: Mapping[tuple[str, str], str], cameras: Sequence[str], options: SilhouetteOptions
) -> str | None:
    """Why silhouettes are not made, None if they are.

    statuses: (left, right) -> `ok` or why a pair is not matched;  cameras: those that take part
    Raises InputError for an unknown `use`.
    """
    if options.use not in USES:
        raise InputError(
            f"expected silhouettes use among {', '.join(USES)}, got {options.use}: correct the config"
        )
    if options.use == "never":
        return "not used: silhouettes use is never"
    if len(cameras) < 2:
        return f"one camera: a hull takes silhouettes of two, got {len(cameras)}"
    if options.use == "always":
        return None
    matched = [pair for pair, status in statuses.items() if status == "ok" and set(pair) <= set(cameras)]
    wanted = min(options.min_pairs, len(cameras) - 1)
    if all(sum(camera in pair for pair in matched) >= wanted for camera in cameras):
        return f"stereo suffices: {len(matched)} of {len(statuses)} pairs are matched"
    return None
