"""Checks as rows with their thresholds, and reasons grouped over cameras."""

from __future__ import annotations

import math

from calibgraph.model.verdict import Check, Verdict
from calibgraph.report.check_table import Reason, check_row, check_rows, group_reasons


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


def test_a_check_that_fails_and_warns_is_one_reason() -> None:
    def z_score(value: float) -> Check:
        status = "FAIL" if value < 8 else "WARN"
        text = f"z-score {value:g} is below {8 if status == 'FAIL' else 15}: check the guess"
        return Check("z-score", status, text, value, 15.0, 8.0)

    verdicts = {"left": Verdict((z_score(14.0),)), "right": Verdict((z_score(5.0),))}
    assert group_reasons(verdicts, {}) == [
        Reason(
            "FAIL",
            "right, left",
            "z-score: right 5 (FAIL: limit 8); left 14 (WARN: limit 15): check the guess",
        )
    ]


def test_sentences_that_differ_in_a_number_are_one_reason() -> None:
    def missed(value: float) -> Verdict:
        return Verdict((Check("search", "FAIL", f"not found (best {value}): give 6 more", value),))

    assert group_reasons({"left": missed(3.1), "right": missed(2.9)}, {}) == [
        Reason("FAIL", "left, right", "not found (best 3.1, 2.9): give 6 more")
    ]


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
            "spread: left 0.3 deg, right 0.4 deg (WARN: limit 0.25 deg): check the lens",
        ),
        Reason("", "left, right", "loose height"),
    ]
