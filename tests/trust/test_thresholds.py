"""One table of thresholds: no row without a check, no graded check without a row."""

from __future__ import annotations

import math

import pytest

from calibgraph.model.threshold import Threshold
from calibgraph.trust.thresholds import THRESHOLDS, limit


@pytest.mark.parametrize("row", THRESHOLDS, ids=lambda row: row.key)
def test_a_row_grades_from_pass_to_fail(row: Threshold) -> None:
    beyond = 1 if row.direction == "at most" else -1
    assert beyond * row.fail > beyond * row.warn
    assert row.check(row.warn).status == "PASS"
    assert row.check(row.fail).status == "WARN"
    assert row.check(row.fail + beyond).status == ("WARN" if math.isinf(row.fail) else "FAIL")
    assert row.check(math.nan).status == row.grade(math.nan) == "FAIL"


def test_a_limit_grows_with_the_tolerance_and_is_exact_at_the_default() -> None:
    assert [limit("competing_rotation", (deg, 10.0)) for deg in (0.1, 0.5, 1.0)] == [0.3, 0.3, 0.6]
    assert limit("competing_translation", (0.1, 30.0)) == pytest.approx(30.0)
    assert limit("swap_slack", (5.0, 100.0)) == limit("swap_slack")
