"""Stage `background`: the static background of every pose of a view (section 3.2 of the paper).

In: views/{view}.json, sfm/cameras.json, disparity/{pair}/samples.npz of all pairs, frames/cameras/{cam}.npz.
Out: background/{view}/{chunk}.npz (docs/formats.md).

What stands still has the same depth at all sampled times. So depth is voted first, over all pairs and
times at once; colour is sampled once for that depth, from all sampled pictures, and each pixel takes the
weighted median of them.
"""

from fourd.background.options import BackgroundOptions

STAGE_VERSION = 3

__all__ = ["STAGE_VERSION", "BackgroundOptions"]
