"""What a rectification file says of its pair, without the geometry: cheap to import and to read."""

from pathlib import Path
from typing import Any

from fourd.errors import explain_faults
from fourd.io import Archive


def read_pair_meta(path: Path) -> dict[str, Any]:
    """Meta of a rectification file: `left`, `right`, `status` (`ok`, or why they are not matched) and more.

    Raises InputError for another file.
    """
    with Archive(path) as archive, explain_faults(f"a rectification of this workflow at {path}"):
        names = {key: str(archive.meta[key]) for key in ("left", "right", "status")}
        return {**archive.meta, **names}
