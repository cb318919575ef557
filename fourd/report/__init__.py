"""Stage `report`: one page about one scene, from files that other stages left.

`document` gathers every figure into one JSON object with a schema (`report.schema.json`), `pictures`
makes small pictures of every stage, `page` turns both into one HTML file that needs no network, no
server and no other file. What is not there is said on the page with its reason.
"""

import dataclasses

STAGE_VERSION = 3


@dataclasses.dataclass(frozen=True)
class ReportOptions:
    """The meaning of each key is in config/schemas/report.schema.yaml."""

    max_views: int = 4
    max_frames: int = 3
    picture_px: int = 480
    error_gain: float = 4.0
    truth: str = ""
