"""Stage `sfm`: cameras of the scene, world re-centred and re-scaled, with near and far.

Cameras are known and imported here (`fourd.sfm.importers`). Importing this package loads neither
an importer nor pycolmap: readers of `cameras.json` pay nothing for them.
"""

from fourd.sfm.cameras import SceneCameras, read_cameras, write_cameras
from fourd.sfm.options import SfmOptions

STAGE_VERSION = 2

__all__ = ["STAGE_VERSION", "SceneCameras", "SfmOptions", "read_cameras", "write_cameras"]
