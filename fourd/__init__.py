"""From hand-held videos of one event to films from cameras that were not there."""

__version__ = "0.1.0"
