"""Stage `silhouettes`: what moves in every picture, where cameras stand too far apart for stereo.

In: frames/cameras/{cam}.npz, sfm/cameras.json, rectification/{pair}.npz of all pairs, a film of the empty
scene if there is one. Out: silhouettes/{cam}/plate.npz and silhouettes/{chunk}.npz (docs/formats.md).
"""

from fourd.silhouettes.options import SilhouetteOptions

STAGE_VERSION = 1

__all__ = ["SilhouetteOptions"]
