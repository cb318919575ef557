"""Marks of unfinished outputs, written by the engine itself."""

from pathlib import Path
from types import SimpleNamespace

from snakemake.io import IOFile
from snakemake.persistence.file import FilePersistence

from fourd.plan.marks import marked_outputs


def test_marks_of_the_engine_are_read_whatever_the_length_of_the_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    engine = FilePersistence()
    outputs = {"results/demo/disparity/cam00-cam01/samples.npz", "results/größe/" + "a" * 300 + "/b.npz"}
    engine.started(SimpleNamespace(output=[IOFile(name, rule=None) for name in outputs]))
    assert marked_outputs(Path(".snakemake")) == outputs


def test_without_records_or_with_foreign_files_nothing_is_marked(tmp_path):
    assert marked_outputs(tmp_path) == set()
    (tmp_path / "incomplete").mkdir()
    (tmp_path / "incomplete" / "migration_underway").touch()
    (tmp_path / "incomplete" / "ä").touch()
    assert marked_outputs(tmp_path) == set()
