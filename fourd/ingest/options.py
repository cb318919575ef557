"""Settings of the stage."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class IngestOptions:
    """Settings of the stage (config/schemas/ingest.schema.yaml)."""

    verify: bool = True
    square_pixels: bool = True
