"""Stage `frames`: pictures of all cameras in common colours, at the moments of the common clock.

`colour` compares what stands still in several cameras and writes the correction of every camera;
`prepare` writes, per camera, everything that is needed to read its picture of a scene frame.
"""

from fourd.frames.options import FramesOptions

STAGE_VERSION = 1

__all__ = ["STAGE_VERSION", "FramesOptions"]
