"""People in the pictures of one moment: found in each view, joined across views, fitted with a body.

`pose` finds 33 landmarks of every person in a picture, `people` joins persons across views and
triangulates, `body` is the parametric body and `fit` its fit, `mesh` draws it. The networks and the
body are fetched on request (`python -m fourd.fetch humans --output DIR`); `missing_models` says why
they cannot be used.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fourd.baselines.humans.body import NUM_PARAMETERS, BodyModel, read_body
from fourd.baselines.humans.fit import fit_parameters, is_plausible
from fourd.baselines.humans.people import find_people
from fourd.baselines.humans.pose import PoseNetwork
from fourd.camera import Camera

POSE_FOLDER = "pose"
BODY_FOLDER = "body"
HOW_TO_GET = (
    "install the extra `humans` (pip install 'fourd[humans]'), run `python -m fourd.fetch humans "
    "--output DIR` and set evaluate humans to DIR"
)
NO_MODELS = f"no models are given: {HOW_TO_GET}"


@dataclasses.dataclass(frozen=True, eq=False)
class HumanModels:
    """The networks and the body."""

    network: PoseNetwork
    body: BodyModel

    def fit_people(self, pictures: Mapping[str, tuple[np.ndarray, Camera]]) -> np.ndarray:
        """(N, NUM_PARAMETERS) float64 of the body, world units; people seen in most views first.

        pictures: (H, W, 3) uint8 and its pinhole by camera, all of one moment
        Finds that fit no body are left out: two views may agree on what is nobody.
        """
        found = {name: self.network.find(image) for name, (image, _) in pictures.items()}
        people = find_people(found, {name: camera for name, (_, camera) in pictures.items()})
        fits = [fit_parameters(self.body, person) for person in people]
        # The one that most views share is believed; others are of about the same size.
        kept = [
            fit
            for person, fit in zip(people, fits, strict=True)
            if is_plausible(self.body, person, fit, fits[0])
        ]
        return np.array(kept).reshape(-1, NUM_PARAMETERS)


def missing_models(folder: str) -> str | None:
    """Why people cannot be fitted, None if they can."""
    if not folder:
        return NO_MODELS
    for part in (POSE_FOLDER, BODY_FOLDER):
        if not (Path(folder) / part).is_dir():
            return f"no folder {Path(folder) / part}: {HOW_TO_GET}"
    if importlib.util.find_spec("ai_edge_litert") is None:
        return f"the package ai-edge-litert is not installed: {HOW_TO_GET}"
    return None


@functools.lru_cache(maxsize=1)
def load_models(folder: str) -> HumanModels:
    """The models of a folder for which `missing_models` has no reason. Raises InputError for other files."""
    return HumanModels(PoseNetwork(Path(folder) / POSE_FOLDER), load_body(folder))


@functools.lru_cache(maxsize=1)
def load_body(folder: str) -> BodyModel:
    """The body alone, which places fits without the networks. Raises InputError for other files."""
    return read_body(Path(folder) / BODY_FOLDER)
