"""Write docs/configuration.md from the schemas: `python -m fourd.config_docs [--output FILE]`."""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fourd import config
from fourd.cli import run_stage
from fourd.io import write_text

HEADER = """# Configuration

Written by `python -m fourd.config_docs` from `config/schemas/`; a test keeps the two together.

A setting is taken from the first place that has it: the command line (`--config 'fuse={min_pairs: 4}'`),
`config/config.yaml`, `settings:` of the scene file, the default below. Unknown keys, wrong types and
values out of range stop the run before the first job.
"""


def _allowed(entry: Mapping[str, Any]) -> str:
    if "enum" in entry:
        return ", ".join(f"`{value}`" for value in entry["enum"])
    kind = entry.get("type", "any")
    words = [" or ".join(kind) if isinstance(kind, list) else kind]
    for keyword, sign in (
        ("minimum", "≥"),
        ("exclusiveMinimum", ">"),
        ("maximum", "≤"),
        ("exclusiveMaximum", "<"),
    ):
        bounds = entry if keyword in entry else entry.get("items", {})
        if keyword in bounds:
            words.append(f"{sign} {bounds[keyword]:g}")
    return " ".join(words)


def _table(properties: Mapping[str, Any]) -> list[str]:
    lines = ["| key | default | allowed | meaning |", "|---|---|---|---|"]
    for key, entry in properties.items():
        default = json.dumps(entry["default"]) if "default" in entry else "required"
        meaning = " ".join(str(entry.get("description", "")).split())
        lines.append(f"| `{key}` | `{default}` | {_allowed(entry)} | {meaning} |".replace("||", "| |"))
    return lines


def render_reference() -> str:
    """The configuration reference as Markdown."""
    schema = config.load_config_schema()["properties"]
    top = {key: entry for key, entry in schema.items() if "properties" not in entry}
    lines = [HEADER, "## Top level", "", *_table(top), ""]
    for section, entry in schema.items():
        if "properties" in entry:
            lines += [f"## {section}", "", entry.get("description", ""), "", *_table(entry["properties"]), ""]
    scene = config.load_yaml(config.SCHEMA_FOLDER / "scene.schema.yaml")
    lines += ["## Scene files, config/scenes/NAME.yaml", "", scene["description"], ""]
    lines += [*_table(scene["properties"]), "", "Each entry of `cameras`:", ""]
    lines += [*_table(scene["properties"]["cameras"]["additionalProperties"]["properties"]), ""]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("docs/configuration.md"))
    write_text(parser.parse_args(argv).output, render_reference())


if __name__ == "__main__":
    sys.exit(run_stage(main))
