"""Stage `plan`: what a scene needs, what is left out and why, and what the rest will cost.

In: sfm/cameras.json, rectification/{pair}.npz, silhouettes/need.json, align/maps. Out: plan/survey.json,
which the job graph follows, and plan/plan.json, the decisions with a forecast (docs/formats.md).
"""

STAGE_VERSION = 1
