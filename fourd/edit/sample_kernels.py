"""Inner loop of looking up depth maps where world points lie."""

import numpy as np
from numba import njit


@njit(cache=True)
def look_up(
    points: np.ndarray,
    image_from_world: np.ndarray,
    offset: np.ndarray,
    depth: np.ndarray,
    seen: np.ndarray,
    z: np.ndarray,
) -> None:
    """Write what an ideal pinhole sees at points, and how far they are.

    points: (N, 3) float64 world;  image_from_world: (3, 3) float64 K R;  offset: (3,) float64 K t
    depth: (H, W) float32 z;  seen: (N,) float32, of the nearest pixel, NaN outside;  z: (N,) float64
    """
    height, width = depth.shape
    m, o = image_from_world, offset
    for i in range(len(points)):
        x, y, w = points[i, 0], points[i, 1], points[i, 2]
        far = m[2, 0] * x + m[2, 1] * y + m[2, 2] * w + o[2]
        z[i] = far
        seen[i] = np.nan
        if far > 0:
            column = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * w + o[0]) / far
            row = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * w + o[1]) / far
            if -0.5 <= column < width - 0.5 and -0.5 <= row < height - 0.5:
                seen[i] = depth[int(np.rint(row)), int(np.rint(column))]
