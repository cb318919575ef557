"""Every case of the stability suite is a test; the command line says the same in a table."""

import json

import pytest

from fourd import cli, io
from fourd.stability import all_cases
from fourd.stability.__main__ import COLUMNS, choose_cases, main, row_of
from fourd.stability.case import (
    BAD,
    REFUSED,
    RIGHT,
    Case,
    Outcome,
    elementwise_difference,
    judge_refusal,
    reason_of,
    relative_difference,
    run_case,
)

CASES = all_cases()


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.group}-{case.name.replace(' ', '_')}")
def test_case(case):
    outcome = run_case(case).outcome
    assert outcome.verdict in (RIGHT, REFUSED), outcome.got


def test_every_case_says_what_is_expected_and_is_named_once():
    names = [(case.group, case.name) for case in CASES]
    assert len(set(names)) == len(names) > 100
    assert all(case.expected and len(case.expected) < 120 for case in CASES)


def test_a_case_that_stops_is_bad_and_named():
    def divide() -> Outcome:
        return Outcome(str(1 // 0), RIGHT)

    outcome = run_case(Case("numerics", "division by zero", "an answer", divide)).outcome
    assert outcome.verdict == BAD
    assert "ZeroDivisionError" in outcome.got


def test_refusals_count_only_with_their_cause():
    assert judge_refusal("the epipole lies in the image", "epipole").verdict == REFUSED
    assert judge_refusal("something went wrong", "epipole").verdict == BAD
    assert judge_refusal(None, "epipole").verdict == BAD
    assert reason_of(int, "twelve") is not None
    assert reason_of(int, "12") is None


def test_differences_never_call_a_nan_equal():
    assert relative_difference([1.0, 2.0], [1.0, 4.0]) == 0.5
    assert relative_difference([float("nan")], [1.0]) == float("inf")
    assert relative_difference([0.0], [0.0]) == 0
    assert elementwise_difference([1.0, float("nan")], [2.0, float("nan")]) == 0.5
    assert elementwise_difference([float("nan")], [1.0]) == float("inf")


def test_cases_are_chosen_by_words():
    chosen = choose_cases(CASES, ["geometry", "focal"])
    assert [case.name for case in chosen] == ["focal ratio of 10", "focal ratio of 2"]


def test_command_line_writes_the_table(tmp_path, capsys):
    main(["--only", "pictures", "tone", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "tone at the ends" in printed and "1 right, 0 refused, 0 bad" in printed
    (row,) = io.read_csv(tmp_path / "stability.csv")
    assert tuple(row) == COLUMNS
    assert row["verdict"] == RIGHT
    document = json.loads((tmp_path / "stability.json").read_text())
    assert document["schema_version"] == io.SCHEMA_VERSION
    assert document["counts"] == {RIGHT: 1, REFUSED: 0, BAD: 0}
    assert document["cases"][0]["case"] == "tone at the ends"


def test_a_bad_case_ends_with_a_sentence_and_status_1(monkeypatch, capsys):
    bad = Case("numerics", "no answer", "an answer", lambda: Outcome("nothing", BAD))
    monkeypatch.setattr("fourd.stability.__main__.all_cases", lambda: (bad,))
    with pytest.raises(SystemExit, match="error: 1 of 1 cases are bad: numerics: no answer"):
        main([])
    assert row_of(run_case(bad))["verdict"] in capsys.readouterr().out


def test_words_of_no_case_are_refused(capsys):
    assert cli.run_stage(main, ["--only", "unheard-of"]) == 2
    assert "error: --only: expected words of a case, got unheard-of" in capsys.readouterr().err
