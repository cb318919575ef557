"""Stage `viewer`: a page that plays the event in any browser, from the disk or from any static host.

`lattice` chooses which moments are rendered from which places so that the page keeps within its bytes,
`maps` keeps of each of these pictures where its pixels come from, `pack` makes small files of pictures
and maps, `manifest` says what the page must know of cameras and times, `page` writes it all. The page's
own program is built from `viewer/` at the top of the repository and lies in `assets`.
"""

import dataclasses

STAGE_VERSION = 3


@dataclasses.dataclass(frozen=True)
class ViewerOptions:
    """The meaning of each key is in config/schemas/viewer.schema.yaml."""

    max_mb: float = 20.0
    width: int = 640
    num_views: int | None = None
    quality: int = 75
