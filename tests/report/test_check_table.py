"""Checks as rows with their thresholds."""

from __future__ import annotations

import math

from calibgraph.model.verdict import Check
from calibgraph.report.camera_section import check_row, check_rows


def test_the_order_of_the_thresholds_is_the_side_that_is_bad() -> None:
    row = check_row(Check("spread", "PASS", "", 0.1, 0.25, 0.5, "deg"))
    assert (row.found, row.warn, row.fail) == ("0.1 deg", "> 0.25 deg", "> 0.5 deg")
    row = check_row(Check("inliers", "WARN", "", 0.5, 0.6, 0.3, "share"))
    assert (row.found, row.warn, row.fail) == ("50%", "< 60%", "< 30%")


def test_thresholds_that_no_value_reaches_are_not_shown() -> None:
    assert check_row(Check("distance", "PASS", "", 0.2, 2.0, math.inf, "m")).fail == ""
    assert check_row(Check("frames", "PASS", "", 6.0, 5.0, 0.0)).fail == ""
    row = check_row(Check("distance from the guess", "WARN", "", 40.0, 30.0, 360.0, "deg"))
    assert (row.warn, row.fail) == ("> 30 deg", "")
    row = check_row(Check("prior share", "WARN", "", 0.7, 0.5, 1.0, "share"))
    assert (row.warn, row.fail) == ("> 50%", "")
    row = check_row(Check("converged", "PASS", "the optimizer converged"))
    assert (row.found, row.warn, row.fail) == ("", "", "")


def test_limits_below_zero_are_shown_for_a_share_of_a_score() -> None:
    row = check_row(Check("own clouds", "PASS", "", 0.4, -0.05, -0.2, "share"))
    assert (row.warn, row.fail) == ("< -5%", "< -20%")


def test_the_worst_checks_come_first() -> None:
    names = {"a": "PASS", "b": "WARN", "c": "PASS", "d": "FAIL", "e": "WARN"}
    rows = check_rows([Check(name, status, "") for name, status in names.items()])
    assert [row.check.name for row in rows] == ["d", "b", "e", "a", "c"]


def test_counts_are_shown_without_an_exponent() -> None:
    assert check_row(Check("correspondences", "PASS", "", 12_345.0, 50.0, 0.0)).found == "12345"
