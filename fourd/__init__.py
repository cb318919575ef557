"""From hand-held videos of one event to films from cameras that were not there."""

import os

__version__ = "0.1.0"

# Before OpenMP is loaded, which reads it once: on a busy machine threads that wait by spinning take the
# cores from those they wait for, and training becomes five times slower (docs/performance.md).
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
