"""Checks as rows with their thresholds, and reasons grouped over cameras."""

from __future__ import annotations

import math

from calibgraph.model.verdict import Check, Verdict
from calibgraph.report.check_table import Reason, check_row, group_reasons


def test_the_order_of_the_thresholds_is_the_side_that_is_bad() -> None:
    row = check_row(Check("spread", "PASS", "", 0.1, 0.25, 0.5, "deg"))
    assert (row.found, row.warn, row.fail) == ("0.1 deg", "> 0.25 deg", "> 0.5 deg")
    row = check_row(Check("inliers", "WARN", "", 0.5, 0.6, 0.3, "share"))
    assert (row.found, row.warn, row.fail) == ("50%", "< 60%", "< 30%")


def test_thresholds_that_no_value_reaches_are_not_shown() -> None:
    assert check_row(Check("distance", "PASS", "", 0.2, 2.0, math.inf, "m")).fail == ""
    assert check_row(Check("frames", "PASS", "", 6.0, 5.0, 0.0)).fail == ""
    row = check_row(Check("converged", "PASS", "the optimizer converged"))
    assert (row.found, row.warn, row.fail) == ("", "", "")


def test_counts_are_shown_without_an_exponent() -> None:
    assert check_row(Check("correspondences", "PASS", "", 12_345.0, 50.0, 0.0)).found == "12345"


def test_equal_reasons_are_one_sentence_for_all_their_cameras() -> None:
    def spread(value: float) -> Check:
        text = f"spread {value} deg is above 0.25 deg: check the lens"
        return Check("spread", "WARN", text, value, 0.25, 0.5, "deg")

    failed = Check("convergence", "FAIL", "the optimizer did not converge")
    verdicts = {"left": Verdict((spread(0.3),)), "right": Verdict((spread(0.4), failed))}
    weaknesses = {"left": ("loose height",), "right": ("loose height",)}
    assert group_reasons(verdicts, weaknesses) == [
        Reason("FAIL", "right", "the optimizer did not converge"),
        Reason(
            "WARN",
            "left, right",
            "spread: left 0.3 deg, right 0.4 deg; limit 0.25 deg: check the lens",
        ),
        Reason("", "left, right", "loose height"),
    ]
