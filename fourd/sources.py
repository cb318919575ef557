"""What a scene is made from: is it there, and is it what it was?"""

import hashlib
from pathlib import Path

from fourd.config import Scene
from fourd.errors import InputError


def check_sources(scene: Scene, made_by_rules: tuple[str, ...]) -> None:
    """Raise InputError for the first source or calibration file that is not there.

    made_by_rules: beginnings of paths that the workflow itself makes
    """
    named = {f"camera {name}": camera.source for name, camera in scene.cameras.items()}
    named |= {
        f"background of camera {name}": camera.background
        for name, camera in scene.cameras.items()
        if camera.background
    }
    named |= {f"calibration file {i + 1}": path for i, path in enumerate(scene.calibration)}
    for what, path in named.items():
        if not path.startswith(made_by_rules) and not Path(path).exists():
            raise InputError(
                f"scene {scene.name}, {what}: expected a file or folder at {path}, found nothing: "
                f"correct the path in config/scenes/{scene.name}.yaml (paths start at {Path.cwd()})"
            )


def source_stamp(source: str, made_by_rules: tuple[str, ...]) -> str:
    """What changes when a source is replaced, even by an older file; empty for what rules make.

    Times and sizes, not content: this is asked of every source whenever the job graph is built.
    """
    if source.startswith(made_by_rules):
        return ""
    path = Path(source)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    stats = [(file.name, file.stat()) for file in files if file.is_file()]
    words = "\n".join(f"{name} {stat.st_size} {stat.st_mtime_ns}" for name, stat in stats)
    return hashlib.sha256(words.encode()).hexdigest()
