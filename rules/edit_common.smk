"""The edits of the scene, and helper functions of their rules."""

from fourd.edit.spec import load_edits

try:
    EDITS = load_edits(
        SCENE.name,
        list(SCENE.cameras),
        SCENE.num_frames,
        {name: VIEW_FRAMES[name] for name in TRAJECTORIES},
    )
except InputError as error:
    raise WorkflowError(str(error)) from None


wildcard_constraints:
    edit="|".join(EDITS) or "none",


def edited_chunks(view):
    return chunks_of_view(view) if view in TRAJECTORIES else CHUNKS


def edited_frames(wildcards):
    if wildcards.view in TRAJECTORIES:
        return frames_of_view(wildcards.view, wildcards.chunk)
    return list(fourd_config.frames_of_chunk(wildcards.chunk))


def views_of_marks(wildcards):
    """Trajectories that marks were drawn on; a camera's poses are known without."""
    views = {mark.view for mark in EDITS[wildcards.edit].marks} & set(TRAJECTORIES)
    return expand("<results>/<scene>/views/{view}.json", view=sorted(views))


def disparities_of_depths(wildcards):
    """Of all pairs: a camera may help to measure its own depth."""
    return expand(
        "<results>/<scene>/disparity/{pair}/{chunk}.npz",
        pair=pairs_without(""),
        chunk=wildcards.chunk,
    )


def disparities_of_edit(wildcards):
    """A thing from another time needs the disparities of that time."""
    chunks = CHUNKS
    if not EDITS[wildcards.edit].shift_frames:
        is_film = wildcards.view in TRAJECTORIES
        chunks = scene_chunks(wildcards.view, wildcards.chunk) if is_film else [wildcards.chunk]
    return expand(
        "<results>/<scene>/disparity/{pair}/{chunk}.npz",
        pair=pairs_without(wildcards.view),
        chunk=chunks,
    )


def base_of_edit(wildcards):
    """What an edited view is made from: rendered frames of a trajectory, or a camera's film."""
    if wildcards.view in TRAJECTORIES:
        names = {
            "view": "views/{view}.json",
            "background": "background/{view}/{chunk}.npz",
            "base": "render/{view}/{chunk}",
        }
    else:
        names = {
            "view": "edit/views/{view}.json",
            "background": "edit/background/{view}/{chunk}.npz",
            "base": "frames/cameras/{view}.npz",
        }
    return {key: f"<results>/<scene>/{name}" for key, name in names.items()}


def base_flag(wildcards):
    return "--rendered" if wildcards.view in TRAJECTORIES else "--film"


def files_of_edit(wildcards):
    return EDITS[wildcards.edit].files()
