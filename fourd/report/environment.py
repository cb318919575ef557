"""What a run can be repeated from: versions, seeds, settings and the command."""

import importlib.metadata
import os
import platform
from collections.abc import Iterator, Mapping
from typing import Any

# Packages that the results depend on: the dependencies of the project.
PACKAGES = (
    "torch", "snakemake", "opencv-contrib-python-headless", "pycolmap", "av", "numpy", "scipy", "numba",
    "jsonschema", "PyYAML", "Pillow", "matplotlib",
)  # fmt: skip
# Set by the workflow when it starts; the same results come from another command with the same settings.
COMMAND_VARIABLE = "FOURD_COMMAND"


def collect_environment(settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """The part `environment` of the report. settings: the configuration with all defaults filled in."""
    return {
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "num_cores": os.cpu_count(),
        "packages": {name: _version(name) for name in PACKAGES},
        "seeds": dict(find_seeds(settings or {})),
        "settings": settings,
        "command": os.environ.get(COMMAND_VARIABLE),
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def find_seeds(settings: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, int]]:
    """Every key named `seed`, with the sections above it."""
    for key, value in settings.items():
        name = f"{prefix}.{key}" if prefix else key
        if isinstance(value, Mapping):
            yield from find_seeds(value, name)
        elif key == "seed":
            yield name, value
