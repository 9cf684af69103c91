from __future__ import annotations

from collections.abc import Callable

import pytest

from calibgraph import Check, Verdict
from calibgraph.model.verdict import at_least, at_most, rig_verdict


def test_the_worst_check_decides_and_its_reason_comes_first() -> None:
    verdict = Verdict(
        (at_most("a", 2, 1, 3, "m"), at_most("b", 0, 1, 3, "m"), at_least("c", 0, 2, 1, ""))
    )
    assert verdict.status == "FAIL"
    assert [reason[0] for reason in verdict.reasons] == ["c", "a"]
    assert rig_verdict({"front": verdict}).reasons[0] == "front: c 0 is below 1"


@pytest.mark.parametrize("check", [at_most, at_least])
def test_nan_fails(check: Callable[..., Check]) -> None:
    assert check("a", float("nan"), 1, 2, "m").status == "FAIL"


def test_a_number_at_the_threshold_does_not_contradict_itself() -> None:
    assert at_least("kept", 0.59999, 0.6, 0.3, "share").text == "kept 59.999% is below 60%"
    assert at_most("x", 1.0, 1.0, 2.0, "m").status == "PASS"
