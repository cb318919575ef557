"""Files of the stage: facts read from earlier stages, plan/survey.json written and read."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fourd.errors import InputError, explain_faults
from fourd.plan.cost import Machine, read_machine
from fourd.plan.work import PairFacts, Survey


def read_pair_facts(paths: Sequence[Path]) -> dict[str, PairFacts]:
    """LEFT-RIGHT -> facts, of rectification files. Raises InputError for another file."""
    # Imported here: the job graph reads survey.json through this module and needs no OpenCV.
    from fourd.stereo.pairs import read_pair_meta

    facts = {}
    for path in paths:
        meta = read_pair_meta(path)
        with explain_faults(f"a rectification of this workflow at {path}"):
            ranges = meta["guard"]
            low, high = ranges.get("disparity_low", [None])[0], ranges.get("disparity_high", [None])[-1]
            facts[f"{meta['left']}-{meta['right']}"] = PairFacts(
                status=meta["status"],
                kind=meta["kind"],
                angle_deg=meta["angle_deg"],
                size=(int(meta["size"][0]), int(meta["size"][1])),
                num_disparities=None if low is None or high is None else float(high) - float(low),
            )
    return facts


def read_motion(paths: Sequence[Path], inputs: Sequence[str]) -> dict[str, str]:
    """Input camera -> status of its motion map. Raises InputError for another file."""
    from fourd.io import Archive

    statuses = {}
    for path in paths:
        with Archive(path) as archive, explain_faults(f"motion maps at {path}"):
            statuses[str(archive.meta["name"])] = str(archive.meta["status"])
    return {name: status for name, status in statuses.items() if name in inputs}


def survey_to_dict(survey: Survey) -> dict[str, Any]:
    """The survey as JSON has it."""
    return json.loads(json.dumps(dataclasses.asdict(survey)))


def read_survey(path: Path | str) -> Survey:
    """plan/survey.json. Raises InputError if it is missing or of another shape."""
    # Not through fourd.io: every call of the workflow reads this file, and needs no OpenCV.
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
        pairs = {
            name: PairFacts(**{**pair, "size": tuple(pair["size"])})
            for name, pair in document["pairs"].items()
        }
        return Survey(pairs, str(document["silhouettes"]), dict(document["motion"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"expected the survey of a scene in {path}, got: {error!r}; delete the file and run again"
        ) from None


def read_machine_file(path: Path | str) -> Machine:
    """machine/speed.json. Raises InputError if it is missing or of another shape."""
    try:
        return read_machine(json.loads(Path(path).read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"expected the speed of a machine in {path}, got: {error!r}; delete the file and run again"
        ) from None
