"""Methods that are scored side by side: one module each, all with `render(evidence) -> image`.

A new method is a module with `render` and a line in `METHODS`.
"""

from collections.abc import Callable

import numpy as np

from fourd.baselines import background, inst, nn_same_time, ours, paste
from fourd.baselines.evidence import Evidence

# In the order of the tables; the key is the name in metrics.csv.
METHODS: dict[str, Callable[[Evidence], np.ndarray]] = {
    "nn_same_time": nn_same_time.render,
    "inst": inst.render,
    "background": background.render,
    "paste": paste.render,
    "ours": ours.render,
}
LABELS = {
    "nn_same_time": "N.N. same-time",
    "inst": "Inst",
    "background": "background",
    "paste": "Inst over background",
    "ours": "ours",
}

__all__ = ["LABELS", "METHODS", "Evidence"]
