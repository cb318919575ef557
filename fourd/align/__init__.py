"""Stage `align`: one clock for all cameras, from sound and from what moves.

`listen` compares the films' sound; `track` finds what moves in a film whose cameras are known; `solve`
joins both into clocks; `sample` says which picture of a film belongs to which frame of the scene.
Inputs: ingest/{cam}.json, sfm/film_cameras.json. Outputs: align/ (docs/formats.md).
"""

STAGE_VERSION = 1
