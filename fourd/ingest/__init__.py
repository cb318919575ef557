"""Stage `ingest`: what each camera delivered, frame by frame, on its own clock.

In: a video, a folder of images or one image. Out: `ingest/{cam}.json` and `ingest/{cam}.csv`
(docs/formats.md). A camera's own clock starts at its first frame.
"""

from fourd.ingest.options import IngestOptions
from fourd.ingest.reader import FrameReader, SourceReader, check_film, open_camera, open_source, read_ingest
from fourd.ingest.source import Source, list_images, probe_source

STAGE_VERSION = 2

__all__ = [
    "FrameReader",
    "IngestOptions",
    "Source",
    "SourceReader",
    "check_film",
    "list_images",
    "open_camera",
    "open_source",
    "probe_source",
    "read_ingest",
]
