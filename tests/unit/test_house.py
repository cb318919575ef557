"""Rules of the house that a machine can check."""

import ast
import graphlib
import itertools
import re
import subprocess
import tomllib
from pathlib import Path

import pytest

from fourd.config_docs import render_reference
from tests.conftest import REPOSITORY

MAX_FILE_LINES = 400
MAX_FUNCTION_LINES = 60
MAX_RULE_LINES = 40


def tracked(*patterns: str) -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", *patterns],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    # What is removed but not yet committed is still in the list.
    return [path for path in (REPOSITORY / name for name in names) if path.exists()]


def test_files_and_functions_are_small() -> None:
    for path in tracked("*.py"):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= MAX_FILE_LINES, path
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                assert lines <= MAX_FUNCTION_LINES, f"{path}: {node.name} has {lines} lines"


def imports_among(paths: list[Path]) -> dict[str, dict[str, str]]:
    """Module -> module of the same files that it imports, anywhere in it -> the place."""
    modules = {}
    for path in paths:
        parts = path.relative_to(REPOSITORY).with_suffix("").parts
        modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    found: dict[str, dict[str, str]] = {}
    for module, path in modules.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Import | ast.ImportFrom):
                continue
            names = [alias.name for alias in node.names]
            if isinstance(node, ast.ImportFrom):
                assert node.module and not node.level, f"{path}:{node.lineno}: relative import"
                submodules = [f"{node.module}.{name}" for name in names]
                names = [name if name in modules else node.module for name in submodules]
            for name in set(names) & modules.keys() - {module}:
                found.setdefault(module, {})[name] = f"{path.relative_to(REPOSITORY)}:{node.lineno}"
    return found


@pytest.mark.parametrize("depth", [2, None], ids=["packages", "modules"])
def test_data_flow_one_way(depth: int | None) -> None:
    """No module or package below `fourd` reaches itself by imports, those inside functions included."""
    imports: dict[str, dict[str, str]] = {}
    for module, targets in imports_among(tracked("fourd/*.py")).items():
        for target, place in targets.items():
            first, second = (".".join(name.split(".")[:depth]) for name in (module, target))
            if first != second:
                imports.setdefault(first, {})[second] = place
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        # The list names what is imported before what imports it.
        steps = itertools.pairwise(reversed(error.args[1]))
        pytest.fail("; ".join(f"{a} imports {b} ({imports[a][b]})" for a, b in steps), pytrace=False)


def test_rules_are_small_and_complete() -> None:
    for path in tracked("rules/*.smk", "Snakefile"):
        text = path.read_text(encoding="utf-8")
        rules = re.split(r"^(?=(?:rule|checkpoint) \w+:)", text, flags=re.MULTILINE)[1:]
        for rule in rules:
            body = re.split(r"\n(?=\S)", rule)[0]
            assert len(body.splitlines()) <= MAX_RULE_LINES, body
            assert "run:" not in body
            # Parameters that depend on inputs do not make a changed setting visible.
            assert "lambda wildcards, input" not in body
            if "shell:" in body:
                for directive in ("output:", "log:", "benchmark:", "conda:", "params:"):
                    assert directive in body, f"{path}: no {directive} in\n{body}"
        # One point at which the job graph learns from a result (docs/architecture.md), and no other.
        assert len(re.findall(r"^checkpoint ", text, re.MULTILINE)) == (path.name == "plan.smk"), path


def test_environments_match_the_project() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    pins = set(project["dependencies"]) | {
        pin for extra in project["optional-dependencies"].values() for pin in extra
    }
    files = tracked("envs/*.yaml")
    assert files
    for path in files:
        named = re.findall(r"^\s+- (\S+==\S+)$", path.read_text(), re.MULTILINE)
        assert named, path
        assert set(named) <= pins, path


def test_every_dependency_is_pinned_and_explained() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    explained = (REPOSITORY / "docs" / "architecture.md").read_text().lower()
    for pin in project["dependencies"]:
        name, version = pin.split("==")
        assert version
        assert name.lower() in explained, f"docs/architecture.md does not say why {name} is needed"


def test_configuration_reference_is_current() -> None:
    written = (REPOSITORY / "docs" / "configuration.md").read_text(encoding="utf-8")
    assert written == render_reference(), "run `python -m fourd.config_docs`"


@pytest.mark.parametrize("path", ["README.md", "docs/architecture.md", "docs/formats.md", "CONTRIBUTING.md"])
def test_links_and_paths_in_the_documents_exist(path: str) -> None:
    text = (REPOSITORY / path).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (REPOSITORY / path).parent.joinpath(target).exists(), f"{path} links to {target}"


def test_every_convention_is_pinned_by_a_test() -> None:
    lines = [
        line
        for line in (REPOSITORY / "docs" / "conventions.md").read_text().splitlines()
        if line.startswith("- ")
    ]
    tests = "".join(path.read_text() for path in tracked("tests/unit/*.py"))
    pinned = set(re.findall(r"def test_convention_(\w+)", tests))
    for line in lines:
        named = re.search(r" \(((?:`\w+`(?:, )?)+)\)$", line)
        assert named, f"docs/conventions.md does not say which test pins: {line}"
        assert set(re.findall(r"`(\w+)`", named[1])) <= pinned, line
