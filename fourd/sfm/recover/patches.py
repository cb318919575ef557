"""Where a small patch of one picture lies in another, to a few hundredths of a pixel.

A feature detector places a corner anew in every picture, a few tenths of a pixel off; a patch that
is compared pixel by pixel is not placed anew. Grey levels in float32, positions in float64.
"""

import numba
import numpy as np

MAX_ITERATIONS = 15
STEP_TOLERANCE_PX = 2e-3
# Steps longer than this in one iteration mean that the patch has lost its place.
MAX_STEP_PX = 2.0


@numba.njit(cache=True)
def _cubic_weights(fraction, weights):
    """Catmull-Rom weights of four neighbouring samples. Source: Keys 1981, equation 15, a = -1/2."""
    f2 = fraction * fraction
    f3 = f2 * fraction
    weights[0] = -0.5 * f3 + f2 - 0.5 * fraction
    weights[1] = 1.5 * f3 - 2.5 * f2 + 1
    weights[2] = -1.5 * f3 + 2 * f2 + 0.5 * fraction
    weights[3] = 0.5 * f3 - 0.5 * f2


@numba.njit(cache=True)
def _sample(image, x, y, affine, radius, patch):
    """Fill patch (S, S) around (x, y), its grid mapped by affine (2, 2); False outside the picture."""
    height, width = image.shape
    wx, wy = np.empty(4), np.empty(4)
    for v in range(-radius, radius + 1):
        for u in range(-radius, radius + 1):
            px = x + affine[0, 0] * u + affine[0, 1] * v
            py = y + affine[1, 0] * u + affine[1, 1] * v
            left, top = int(np.floor(px)), int(np.floor(py))
            if left < 1 or top < 1 or left + 2 >= width or top + 2 >= height:
                return False
            _cubic_weights(px - left, wx)
            _cubic_weights(py - top, wy)
            value = 0.0
            for j in range(4):
                row = 0.0
                for i in range(4):
                    row += wx[i] * image[top - 1 + j, left - 1 + i]
                value += wy[j] * row
            patch[v + radius, u + radius] = value
    return True


@numba.njit(cache=True)
def _normalise(values, weights):
    """Zero weighted mean and unit weighted length, in place; False for a flat patch."""
    mean = (weights * values).sum() / weights.sum()
    values -= mean
    length = np.sqrt((weights * values * values).sum())
    if length < 1e-6:
        return False
    values /= length
    return True


@numba.njit(cache=True)
def extract_templates(image, pixels, radius):
    """(N, S, S) float64 samples around pixels (N, 2) with a border of one more, S = 2 radius + 3,
    and (N,) bool whether the picture holds them. image: (H, W) float32"""
    size = 2 * radius + 3
    templates = np.zeros((len(pixels), size, size))
    valid = np.zeros(len(pixels), dtype=np.bool_)
    identity = np.eye(2)
    for n in range(len(pixels)):
        valid[n] = _sample(image, pixels[n, 0], pixels[n, 1], identity, radius + 1, templates[n])
    return templates, valid


@numba.njit(cache=True)
def _window(radius):
    """(S * S,) Gaussian weights that fade towards the patch's border."""
    size = 2 * radius + 1
    weights = np.empty(size * size)
    for v in range(size):
        for u in range(size):
            squared = (u - radius) ** 2 + (v - radius) ** 2
            weights[v * size + u] = np.exp(-squared / (0.5 * (radius + 0.5) ** 2) / 2)
    return weights


@numba.njit(cache=True)
def _prepare(template, weights, num_affine):
    """Normalised reference (S * S,), the solver (num_affine, S * S) from differences to steps, and
    whether the template has enough structure."""
    size = template.shape[0] - 2
    radius = size // 2
    reference = template[1:-1, 1:-1].copy().reshape(-1)
    mean = (weights * reference).sum() / weights.sum()
    length = np.sqrt((weights * (reference - mean) ** 2).sum())
    descent = np.empty((size * size, 6))
    if not _normalise(reference, weights):
        return reference, descent[:, :num_affine].T.copy(), False
    for v in range(size):
        for u in range(size):
            gx = 0.5 * (template[v + 1, u + 2] - template[v + 1, u]) / length
            gy = 0.5 * (template[v + 2, u + 1] - template[v, u + 1]) / length
            row, a, b = v * size + u, u - radius, v - radius
            descent[row, 0], descent[row, 1] = gx, gy
            descent[row, 2], descent[row, 3] = gx * a, gx * b
            descent[row, 4], descent[row, 5] = gy * a, gy * b
    descent = descent[:, :num_affine].copy()
    for k in range(num_affine):
        descent[:, k] -= (weights * descent[:, k]).sum() / weights.sum()
        descent[:, k] -= (weights * descent[:, k] * reference).sum() * reference
    weighted = descent.T.copy() * weights
    normal = weighted @ descent
    trace = np.trace(normal)
    if not np.isfinite(normal).all() or trace <= 0:
        return reference, weighted, False
    normal += 1e-9 * trace * np.eye(num_affine)
    return reference, np.linalg.inv(normal) @ weighted, True


@numba.njit(cache=True)
def _compose(affine, step):
    """The warp after the inverse of the template's step; False if that would turn the patch over."""
    a, b = 1 + step[2], step[3]
    c, d = step[4], 1 + step[5]
    determinant = a * d - b * c
    if not 0.2 < determinant < 5:
        return affine, False
    inverse = np.array([[d, -b], [-c, a]]) / determinant
    return affine @ inverse, True


@numba.njit(cache=True)
def align_patches(image, templates, starts, affines, num_affine):
    """Move every patch to where the picture looks like its template.

    image: (H, W) float32;  templates: (N, S, S) of `extract_templates`
    starts: (N, 2) px;  affines: (N, 2, 2) picture from template around the patch's centre
    num_affine: 6 to let the affine map adapt, 2 for the shift alone
    Returns (N, 2) px and (N,) correlation of patch and template in [-1, 1]; -1 where the patch left
    the picture, was flat or did not settle. Gain and offset of the grey levels do not matter.
    Source: S. Baker and I. Matthews, "Lucas-Kanade 20 years on", inverse compositional algorithm
    with its steepest-descent images made orthogonal to changes of offset and gain.
    """
    radius = (templates.shape[1] - 3) // 2
    weights = _window(radius)
    found = starts.copy()
    score = np.full(len(templates), -1.0)
    patch = np.empty((2 * radius + 1, 2 * radius + 1))
    step = np.zeros(6)
    for n in range(len(templates)):
        reference, solve, is_usable = _prepare(templates[n], weights, num_affine)
        if not is_usable:
            continue
        position, affine = starts[n].copy(), affines[n].copy()
        for _ in range(MAX_ITERATIONS):
            if not _sample(image, position[0], position[1], affine, radius, patch):
                break
            values = patch.copy().reshape(-1)
            if not _normalise(values, weights):
                break
            step[:num_affine] = solve @ (values - reference)
            affine, is_proper = _compose(affine, step)
            shift = -(affine @ step[:2])
            moved = np.sqrt((shift * shift).sum())
            if not is_proper or not moved < MAX_STEP_PX:
                break
            position += shift
            if moved < STEP_TOLERANCE_PX:
                found[n] = position
                score[n] = (weights * values * reference).sum()
                break
    return found, score
