"""Stage `edit`: one mark on one frame of one camera, carried through space and time.

In: config/edits/{edit}.yaml, frames, cameras and disparities of a scene, its backgrounds and generators.
Out: edit/{edit}/masks.npz, edit/{edit}/{view}/{chunk}/ and edit/{edit}/{view}.mp4 (docs/editing.md).
"""

STAGE_VERSION = 4
