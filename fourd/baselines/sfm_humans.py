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

    Raises Unavailable where nobody was looked for, or without sparse points.
    """
    # Loaded only where people were fitted: it takes longer than most jobs' other imports.
    from fourd.baselines.humans import NO_MODELS, load_body
    from fourd.baselines.humans.mesh import colour_surface

    if evidence.people is None:
        raise Unavailable(evidence.no_people or NO_MODELS)
    image = sfm_dense.render(evidence)
    if not len(evidence.people):
        return image
    body = load_body(evidence.humans)
    vertices = [body.place_vertices(fit) for fit in evidence.people]
    faces = np.concatenate([body.faces + i * len(body.vertices) for i in range(len(vertices))])
    inputs = {name: (entry.image, entry.valid, entry.camera) for name, entry in evidence.inputs.items()}
    people, shown = colour_surface(np.concatenate(vertices), faces, evidence.camera, inputs)
    return np.where(shown[..., None], people, image)
