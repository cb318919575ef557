"""What belongs to the scene as it is now.

Results of a camera, a film, an edit, a chunk or a level that the scene no longer has may still lie in its
folders. Whatever the report reads is asked for here first.
"""

import dataclasses
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd.config import chunk_names
from fourd.io import read_json
from fourd.report.costs import FOLDER_OF_RULE, Job

_CHUNK = re.compile(r"(\d{6})-(\d{6})")
SAMPLES = "samples"


@dataclasses.dataclass(frozen=True)
class Current:
    """The scene's own names. None: not known outside the workflow, so whatever lies there counts.

    cameras: all, left-out ones too;  inputs, heldout: names;  views: name -> its output frames
    num_frames: on the scene's clock;  chunk_frames, num_levels, edits: of the configuration
    """

    cameras: frozenset[str]
    inputs: frozenset[str]
    heldout: frozenset[str]
    views: Mapping[str, Sequence[int]]
    num_frames: int
    chunk_frames: int | None = None
    num_levels: int | None = None
    edits: frozenset[str] | None = None

    def has_pair(self, pair: str) -> bool:
        """Whether a pair of cameras may be matched: none of them is held out or gone."""
        return (self.cameras - self.heldout).issuperset(pair.split("-"))

    def has_level(self, level: str) -> bool:
        return self.num_levels is None or int(level) < self.num_levels

    def has_edit(self, name: str) -> bool:
        return self.edits is None or name in self.edits

    def chunks(self, view: str | None = None) -> Collection[str] | None:
        """Chunks of a view's output frames, of the scene's clock for a camera or without a view."""
        if self.chunk_frames is None:
            return None
        frames = self.views.get(view or "", ())
        num_frames = len(frames) if view not in self.cameras and frames else self.num_frames
        return chunk_names(num_frames, self.chunk_frames)

    def chunks_in(self, folder: Path, view: str | None = None) -> list[Path]:
        """Files and folders of chunks below a folder, in their order."""
        allowed = self.chunks(view)
        found = [path for path in sorted(folder.glob("*")) if _CHUNK.fullmatch(path.stem)]
        return [path for path in found if allowed is None or path.stem in allowed]

    def has_job(self, job: Job) -> bool:
        """Whether a job is of this scene. Of a rule that the report does not know nothing can be said."""
        if job.rule not in FOLDER_OF_RULE:
            return True
        return all(self._has_word(word, job) for word in job.words)

    def _has_word(self, word: str, job: Job) -> bool:
        if match := _CHUNK.fullmatch(word):
            first, last = map(int, match.groups())
            return self._has_chunk(word, first, last, job)
        if word.isdigit():
            return self.has_level(word)
        if "-" in word:
            return self.has_pair(word)
        name = word.partition(".")[0]
        if job.rule == "evaluate_camera":
            return name in self.heldout
        is_edit = job.rule.startswith("edit_") and self.has_edit(name)
        return name == SAMPLES or name in self.cameras or name in self.views or is_edit

    def _has_chunk(self, word: str, first: int, last: int, job: Job) -> bool:
        view = next((other for other in job.words if other in self.views), None)
        allowed = self.chunks(view)
        if allowed is None or word in allowed:
            return True
        # Backgrounds of training views are made in groups of as many frames of the view as a chunk has.
        frames = sorted(self.views.get(view or "", ()))
        groups = [
            frames[i : i + (self.chunk_frames or 1)] for i in range(0, len(frames), self.chunk_frames or 1)
        ]
        return job.rule == "estimate_background" and any((g[0], g[-1]) == (first, last) for g in groups)


def read_current(
    results: Path, settings: Mapping[str, Any] | None, num_levels: int | None, edits: Collection[str] | None
) -> Current:
    """From sfm/cameras.json, the views and the configuration. settings: None where it is not known.

    Raises InputError without sfm/cameras.json.
    """
    document = read_json(results / "sfm" / "cameras.json")
    cameras = frozenset({*document["inputs"], *document["heldout"], *document["left_out"]})
    trajectories = None if settings is None else settings.get("trajectories")
    views = {}
    for path in sorted((results / "views").glob("*.json")):
        view = read_json(path)
        is_film = view["role"] == "virtual" and (trajectories is None or path.stem in trajectories)
        if path.stem in cameras or is_film:
            views[path.stem] = [entry["frame"] for entry in view["frames"]]
    return Current(
        cameras,
        frozenset(document["inputs"]),
        frozenset(document["heldout"]),
        views,
        document["num_frames"],
        None if settings is None else settings.get("chunk_frames"),
        num_levels,
        None if edits is None else frozenset(edits),
    )
