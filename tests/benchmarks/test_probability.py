"""How the probability of being off is judged: cuts, reliability, discrimination."""

import pytest

from benchmarks.accuracy.ledger import Record
from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW
from calibgraph.trust.probability import STRUCTURE, WORST
from tools.probability import Sample, fit, probabilities, samples_of


def sample(
    *, off: bool, severity: float = 0.0, by_bar: float = 0.0, kind: str = "outliers"
) -> Sample:
    status = ("PASS", "WARN", "FAIL")[min(int(severity), 2)]
    return Sample(
        level="data", kind="good", severities={kind: severity, WORST: severity},
        by_bar=by_bar, by_values=0.0, off=off, right=not off,
        statuses={kind: status},
    )  # fmt: skip


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
