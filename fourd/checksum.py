"""Is a file the one that was meant?"""

import hashlib
from pathlib import Path

from fourd.errors import InputError


def check_sha256(path: Path, expected: str) -> None:
    """Raise InputError unless the file has this SHA-256, in hexadecimal digits."""
    with path.open("rb") as file:
        found = hashlib.file_digest(file, "sha256").hexdigest()
    if found != expected:
        raise InputError(
            f"expected {path.name} with SHA-256 {expected}, got {found}: the download is damaged or was "
            "changed; run again, and if it stays so do not use it"
        )
