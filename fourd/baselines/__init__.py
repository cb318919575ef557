"""Methods that are scored side by side: one module each, all with `render(evidence) -> image`.

A new method is a module with `render` and a line in `METHODS`. One that cannot run on an event
raises `Unavailable` with the reason that its row in the table gives.
"""

from collections.abc import Callable

import numpy as np

from fourd.baselines import (
    background,
    ibr,
    inst,
    nn_all_times,
    nn_same_time,
    ours,
    paste,
    sfm,
    sfm_dense,
    sfm_humans,
)
from fourd.baselines.evidence import Evidence, InputPicture, Unavailable

Method = Callable[[Evidence], np.ndarray]
# In the order of the tables; the key is the name in metrics.csv.
METHODS: dict[str, Method] = {
    "nn_same_time": nn_same_time.render,
    "nn_all_times": nn_all_times.render,
    "sfm": sfm.render,
    "sfm_dense": sfm_dense.render,
    "sfm_humans": sfm_humans.render,
    "inst": inst.render,
    "background": background.render,
    "paste": paste.render,
    "ibr": ibr.render,
    "ours": ours.render,
}
LABELS = {
    "nn_same_time": "N.N. same-time",
    "nn_all_times": "N.N. all-time",
    "sfm": "SfM",
    "sfm_dense": "SfM densified",
    "sfm_humans": "SfM+humans",
    "inst": "Inst",
    "background": "background",
    "paste": "Inst over background",
    "ibr": "depth-blended IBR",
    "ours": "ours",
}

__all__ = ["LABELS", "METHODS", "Evidence", "InputPicture", "Method", "Unavailable"]
