"""Outputs of jobs that a killed run did not see finished, by the engine's own marks."""

import base64
from pathlib import Path


def marked_outputs(engine_folder: Path) -> set[str]:
    """Outputs whose job began and was not registered as finished.

    Such a file is whole, for stages write to a name of their own and rename, but the engine knows nothing of
    the settings that it was made with and so would never make it again because of them.

    engine_folder: where the engine keeps its records (`.snakemake`). A mark is a file whose path below
    `incomplete/` is the output's path in base64, long ones in folders whose names begin with "@".
    Returns paths as the workflow writes them; empty without marks or with records kept elsewhere.
    """
    folder = engine_folder / "incomplete"
    marks = (path.relative_to(folder).parts for path in folder.rglob("*") if path.is_file())
    outputs = set()
    for parts in marks:
        try:
            outputs.add(base64.urlsafe_b64decode("".join(part.lstrip("@") for part in parts)).decode())
        # Its subclasses stand for wrong characters, wrong lengths and bytes that are no text.
        except ValueError:
            continue
    return outputs
