"""How the probability of being off is judged: cuts, reliability, discrimination."""

import pytest

from benchmarks.accuracy.ledger import Record
from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW
from calibgraph.trust.probability import STRUCTURE, WORST
from tools.probability import (
    Sample,
    cuts,
    discrimination,
    fit,
    probabilities,
    reliability,
    samples_of,
)

MODEL = {
    "intercept": -8.0, "weights": {"outliers": [0.0, 0.0, 16.0]}, "other": [0.0, 0.0, 0.0],
    "seen": ["outliers"], "value_reliability": 1.0, "bar_odds": 1.0,
}  # fmt: skip
"""A check that FAILs makes a result certainly off; no other check says anything."""


def sample(
    *, off: bool, severity: float = 0.0, by_bar: float = 0.0, kind: str = "outliers"
) -> Sample:
    status = ("PASS", "WARN", "FAIL")[min(int(severity), 2)]
    return Sample(
        level="data", kind="good", severities={kind: severity, WORST: severity},
        by_bar=by_bar, by_values=0.0, off=off, right=not off,
        statuses={kind: status},
    )  # fmt: skip


def cells(table: object) -> dict[str, tuple[str, ...]]:
    return {row[0]: row[1:] for row in table.rows}  # type: ignore[attr-defined]


def test_right_results_are_counted_below_the_best_result_that_is_off() -> None:
    right = [sample(off=False, by_bar=p) for p in (0.001, 0.002, 0.03, 0.2)]
    off = [sample(off=True, severity=3.0), sample(off=True, by_bar=0.01)]
    found = cells(discrimination("", MODEL, [*right, *off]))
    assert found["probability"] == ("50%", "50%")


def test_no_result_passes_whose_data_are_missing() -> None:
    missing = sample(off=False, severity=1.5, kind="frames")
    found = cells(discrimination("", MODEL, [missing, sample(off=True, by_bar=0.5)]))
    assert found["probability"] == ("100%", "100%") and found["verdict"] == ("0%", "0%")
    by_class = cuts("", MODEL, [missing])
    row = dict(zip(by_class.columns, by_class.rows[0], strict=True))
    assert row["right: WARN"] == "1" and row["right: PASS"] == "0"


def test_a_certain_and_right_probability_has_no_error() -> None:
    both = [sample(off=False), sample(off=True, severity=3.0)]
    assert probabilities(MODEL, both) == pytest.approx([3e-4, 0.9997], abs=1e-4)
    bins = reliability("", MODEL, both)
    assert bins.title.endswith("mean squared error 0.0000")
    assert [row[1] for row in bins.rows] == ["1", "1"]


def test_a_pose_found_by_chance_counts_beside_a_wrong_lens() -> None:
    checks = [["chance", "PASS", 0.25, 0.5, False], ["lens_focal_length", "WARN", 0.2, 1.5, False]]
    camera: Record = {
        "error_deg": 0.1, "error_cm": 1.0, "covariance": None, "beyond": 0.0, "checks": checks,
    }  # fmt: skip
    (only,) = samples_of([{"level": "data", "kind": "good", "cameras": {"left": camera}}])
    assert only.by_values == pytest.approx(1 - 0.75 * 0.8)
    assert only.severities == {WORST: 0.0}  # neither is one of the graded checks


def test_a_run_has_weights_of_its_worst_check_and_a_fail_is_one_by_itself() -> None:
    right = [sample(off=False, severity=0.5, kind=kind) for kind in "abc" for _ in range(20)]
    off = [sample(off=True, severity=2.5, kind=kind) for kind in "abc" for _ in range(20)]
    model = fit([*right, *off], STRUCTURE)
    assert sorted(model["weights"]) == ["swapped_cameras", WORST]
    assert model["other"] == [0.0, 0.0, 0.0] and model["seen"] == ["a", "b", "c"]
    new = [sample(off=True, severity=severity, kind="new") for severity in (0.5, 2.001, 3.0)]
    low, at_limit, high = probabilities(model, new)
    assert low < PASS_BELOW and FAIL_ABOVE < at_limit < high


def test_error_bars_that_state_too_much_are_relied_on_less() -> None:
    wide = [sample(off=index % 2 == 0, by_bar=0.99) for index in range(40)]
    holds = [sample(off=True, by_bar=0.99) for _ in range(40)]
    right = [sample(off=False) for _ in range(40)]
    found = [fit([*right, *of], STRUCTURE)["bar_odds"] for of in (wide, holds)]
    assert found[0] < 0.5 < found[1]
    assert fit([*right, *wide])["bar_odds"] == 1.0
