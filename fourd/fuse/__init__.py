"""Instantaneous images of a target camera from the disparities of all pairs (section 3.1).

`fuse_view` is the library; `python -m fourd.fuse foreground` is the stage.
"""

from fourd.fuse.geometry import PairFrame
from fourd.fuse.options import ESTIMATES, FuseOptions
from fourd.fuse.view import FusedView, fuse_view

STAGE_VERSION = 4

__all__ = ["ESTIMATES", "STAGE_VERSION", "FuseOptions", "FusedView", "PairFrame", "fuse_view"]
