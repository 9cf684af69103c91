"""One table of thresholds: no row without a check, no graded check without a row."""

from __future__ import annotations

import math
import re

import pytest

from calibgraph import Config, Rig, solve
from calibgraph.model.threshold import Threshold
from calibgraph.trust.thresholds import LIMITS, THRESHOLDS, limit
from docs.thresholds_table import thresholds_markdown
from tests.conftest import ROOT
from tests.trust.conftest import simulated


def keys_looked_up(function: str) -> set[str]:
    """The keys that the package looks up."""
    look_up = re.compile(rf'\b{function}\(\s*"(\w+)"')
    texts = (path.read_text() for path in (ROOT / "calibgraph").rglob("*.py"))
    return {key for text in texts for key in look_up.findall(text)}


@pytest.mark.parametrize(("function", "table"), [("threshold", THRESHOLDS), ("limit", LIMITS)])
def test_every_row_is_used_by_a_check_and_every_key_has_a_row(
    function: str, table: tuple[object, ...]
) -> None:
    keys = [row.key for row in table]
    assert len(set(keys)) == len(keys)
    assert keys_looked_up(function) == set(keys)


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
    for each in LIMITS:
        assert sum(line.startswith(f"| `{each.key}` ") for line in lines) == 1
    assert "| at most 35% | above 90% |" in thresholds_markdown()
    assert "| at least 4 | below 2.5 |" in thresholds_markdown()
    assert "| at least 50 | never |" in thresholds_markdown()


def test_a_limit_grows_with_the_tolerance_and_is_exact_at_the_default() -> None:
    assert [limit("competing_rotation", (deg, 10.0)) for deg in (0.1, 0.5, 1.0)] == [0.3, 0.3, 0.6]
    assert limit("competing_translation", (0.1, 30.0)) == pytest.approx(30.0)
    assert limit("swap_slack", (5.0, 100.0)) == limit("swap_slack")
