"""The body fitted to one person's triangulated landmarks."""

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fourd.baselines.humans.body import LIMB_BONES, NUM_PARAMETERS, BodyModel
from fourd.baselines.humans.people import Person

# Lengths below are shares of the resting body's height.
OUTLIER_SHARE = 0.03
# How far a joint turns, rad, and limbs vary, before it costs as much as a landmark off by OUTLIER_SHARE.
USUAL_TURN_RAD = 1.5
USUAL_LOG_LENGTH = 0.1
STEP = 1e-5
MAX_STEPS = 60
# A person: this share of landmarks, limbs within a quarter of the usual, height within a factor of 2.
MIN_KNOWN_SHARE = 0.75
MAX_LOG_LENGTH = 0.22
MAX_LOG_SIZE = 0.7
# Trunk and limbs that do not bend from rest by much place the body at first.
STEADY = (11, 12, 23, 24)


def fit_parameters(body: BodyModel, person: Person) -> np.ndarray:
    """(NUM_PARAMETERS,) float64 of the body (`BodyModel.pose_bones`).

    Least squares over landmarks with a loss that outliers do not rule, and a pull towards the resting
    pose and proportions, which decides where landmarks are missing.
    """
    target = person.points[body.landmarks]
    known = np.isfinite(target[:, 0])
    weight = np.sqrt(person.weights[body.landmarks][known])
    weight /= weight.max()
    start = _place_first(body, target, known)
    height = float(np.ptp(body.vertices[:, 1]))
    # Weighed at the first guess of the size, or shrinking the person would shrink every error.
    unit = OUTLIER_SHARE * height * np.exp(start[6])
    num_turns = NUM_PARAMETERS - 7 - len(LIMB_BONES)
    usual = np.repeat([USUAL_LOG_LENGTH, USUAL_TURN_RAD], [len(LIMB_BONES), num_turns])

    def miss(parameters: np.ndarray) -> np.ndarray:
        found = body.place_marks(parameters)[:, known]
        errors = (found - target[known]) * (weight / unit)[:, None]
        return np.concatenate([errors.reshape(len(parameters), -1), parameters[:, 7:] / usual], axis=1)

    steps = np.concatenate([np.full(3, STEP * unit), np.full(NUM_PARAMETERS - 3, STEP)])

    def slope(parameters: np.ndarray) -> np.ndarray:
        moved = miss(np.concatenate([parameters + np.diag(steps), parameters - np.diag(steps)]))
        return ((moved[:NUM_PARAMETERS] - moved[NUM_PARAMETERS:]) / (2 * steps)[:, None]).T

    scale = np.concatenate([np.full(3, unit), np.ones(NUM_PARAMETERS - 3)])
    found = least_squares(
        lambda p: miss(p[None])[0],
        start,
        jac=slope,  # type: ignore[arg-type]
        loss="soft_l1",
        x_scale=scale,
        max_nfev=MAX_STEPS,
    )
    return found.x


def is_plausible(body: BodyModel, person: Person, fit: np.ndarray, believed: np.ndarray) -> bool:
    """Whether a fit is a person: most landmarks known and met, limbs and height as people have.

    believed: the fit of the person that most views share
    """
    target = person.points[body.landmarks]
    errors = np.linalg.norm(body.place_marks(fit[None])[0] - target, axis=1)
    height = float(np.ptp(body.vertices[:, 1]) * np.exp(fit[6]))
    limbs = fit[7 : 7 + len(LIMB_BONES)]
    return bool(
        np.isfinite(errors).mean() >= MIN_KNOWN_SHARE
        and np.nanmedian(errors) <= OUTLIER_SHARE * height
        and np.abs(limbs).max() <= MAX_LOG_LENGTH
        and abs(fit[6] - believed[6]) <= MAX_LOG_SIZE
    )


def _place_first(body: BodyModel, target: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Resting pose, turned, scaled and moved onto the trunk's landmarks, or onto all if one is missing."""
    steady = np.isin(body.landmarks, STEADY)
    chosen = steady if known[steady].all() else known
    rest, seen = body.marks[chosen], target[chosen]
    rest_middle, seen_middle = rest.mean(axis=0), seen.mean(axis=0)
    size = np.sqrt(((seen - seen_middle) ** 2).sum() / ((rest - rest_middle) ** 2).sum())
    turn = Rotation.align_vectors(seen - seen_middle, size * (rest - rest_middle))[0]
    parameters = np.zeros(NUM_PARAMETERS)
    root = body.heads[0]
    parameters[:3] = seen_middle + size * turn.apply(root - rest_middle)
    parameters[3:6] = turn.as_rotvec()
    parameters[6] = np.log(size)
    return parameters
