"""One table of thresholds: no row without a check, no graded check without a row."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator

import pytest

from calibgraph import Config, Rig, solve
from calibgraph.model.threshold import Threshold
from calibgraph.trust.thresholds import LIMITS, THRESHOLDS, thresholds_markdown
from tests.conftest import ROOT
from tests.trust.conftest import simulated

TABLE, GRADING = "trust/thresholds.py", "model/threshold.py"


def calls(name: str, *, but_in: tuple[str, ...]) -> Iterator[ast.Call]:
    """All calls of a function in the package, but for some files."""
    package = ROOT / "calibgraph"
    for path in package.rglob("*.py"):
        if path.relative_to(package).as_posix() in but_in:
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == name:
                yield node


def keys_looked_up(function: str) -> list[str]:
    found = [call.args[0] for call in calls(function, but_in=(TABLE,))]
    assert all(isinstance(key, ast.Constant) for key in found)  # so that they can be counted
    return [key.value for key in found]


@pytest.mark.parametrize(("function", "table"), [("threshold", THRESHOLDS), ("limit", LIMITS)])
def test_every_row_is_used_by_a_check_and_every_key_has_a_row(
    function: str, table: tuple[object, ...]
) -> None:
    keys = [row.key for row in table]
    assert len(set(keys)) == len(keys)
    assert set(keys_looked_up(function)) == set(keys)


def test_only_rows_of_the_table_grade_numbers() -> None:
    for function in ("at_most", "at_least"):
        assert not list(calls(function, but_in=(GRADING,)))
    for call in calls("Check", but_in=(GRADING, "io/calibrations.py")):  # which reads them
        limits = {keyword.arg for keyword in call.keywords} & {"warn", "fail"}
        assert len(call.args) <= 4 and not limits, ast.unparse(call)


def test_the_limits_in_a_result_are_those_of_the_table(pair: Rig) -> None:
    rows = {(row.warn, row.fail, row.unit) for row in THRESHOLDS}
    result = solve(pair, simulated(pair), Config(bootstrap=5))
    checks = [check for check in result.verdict.checks if check.warn is not None]
    assert len(checks) > 40
    assert {(check.warn, check.fail, check.unit) for check in checks} <= rows


@pytest.mark.parametrize("row", THRESHOLDS, ids=lambda row: row.key)
def test_a_row_grades_from_pass_to_fail(row: Threshold) -> None:
    beyond = 1 if row.direction == "at most" else -1
    assert beyond * row.fail > beyond * row.warn
    assert row.check(row.warn).status == "PASS"
    assert row.check(row.fail).status == "WARN"
    assert row.check(row.fail + beyond).status == ("WARN" if math.isinf(row.fail) else "FAIL")
    assert row.check(math.nan).status == row.grade(math.nan) == "FAIL"


def test_every_row_has_a_question_and_a_reason() -> None:
    assert all(row.question.endswith((".", "?")) and row.reason for row in THRESHOLDS)
    assert all(row.meaning for row in LIMITS)


def test_the_markdown_has_all_rows() -> None:
    lines = thresholds_markdown().splitlines()
    for row in THRESHOLDS:
        (line,) = [line for line in lines if line.startswith(f"| `{row.key}` ")]
        assert line.count("|") == 7
        assert row.question in line and row.name in line and row.reason in line
        assert f"{row.direction} " in line
    for limit in LIMITS:
        assert sum(line.startswith(f"| `{limit.key}` ") for line in lines) == 1
    assert "| at most 0.25 deg | above 0.5 deg |" in thresholds_markdown()
    assert "| at least 60% | below 30% |" in thresholds_markdown()
    assert "| at least 50 | never |" in thresholds_markdown()
