"""SfM+humans: bodies fitted to the people in the inputs over the densified sparse points.

People are found in every input picture, joined across views, their landmarks triangulated, and a
parametric body is fitted and coloured from the input nearest by angle that sees it
(`fourd.baselines.humans`). The paper fits SMPL to joints of OpenPose (section 4, after Vo et al.); here
the body is MakeHuman's and the networks are BlazePose's, which may be given to everybody.
"""

import numpy as np

from fourd.baselines import sfm_dense
from fourd.baselines.evidence import Evidence, Unavailable


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8; without people it is SfM densified.

    Raises Unavailable without the models or sparse points.
    """
    # Loaded only where people are to be fitted: it takes longer than most jobs' other imports.
    from fourd.baselines.humans import load_models, missing_models
    from fourd.baselines.humans.mesh import colour_surface

    reason = missing_models(evidence.humans)
    if reason is not None:
        raise Unavailable(reason)
    image = sfm_dense.render(evidence)
    models = load_models(evidence.humans)
    bodies = models.fit_people({name: (entry.image, entry.camera) for name, entry in evidence.inputs.items()})
    if not bodies:
        return image
    count = len(models.body.vertices)
    faces = np.concatenate([models.body.faces + i * count for i in range(len(bodies))])
    inputs = {name: (entry.image, entry.valid, entry.camera) for name, entry in evidence.inputs.items()}
    people, shown = colour_surface(np.concatenate(bodies), faces, evidence.camera, inputs)
    return np.where(shown[..., None], people, image)
