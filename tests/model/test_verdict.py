from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Check, Verdict
from calibgraph.model.threshold import Direction, Threshold, beside, in_unit
from calibgraph.model.verdict import (
    ErrorProbability,
    rig_verdict,
)
from calibgraph.trust.thresholds import threshold


def check_of(
    name: str, value: float, direction: Direction, *limits: float, unit: str = ""
) -> Check:
    return Threshold(name, name, direction, *limits, unit, "", "").check(value)


def test_the_worst_check_decides_and_its_reason_comes_first() -> None:
    verdict = Verdict(
        (
            check_of("a", 2, "at most", 1, 3, unit="m"),
            check_of("b", 0, "at most", 1, 3, unit="m"),
            check_of("c", 0, "at least", 2, 1),
        )
    )
    assert verdict.status == "FAIL"
    assert [reason[0] for reason in verdict.reasons] == ["c", "a"]
    assert rig_verdict({"front": verdict}).reasons[0] == "front: c: 0, below the limit 1"


@pytest.mark.parametrize("direction", ["at most", "at least"])
def test_nan_fails(direction: Direction) -> None:
    assert check_of("a", float("nan"), direction, 1, 2, unit="m").status == "FAIL"


def test_a_number_next_to_its_limit_is_told_from_it_in_three_digits() -> None:
    assert (
        check_of("kept", 0.59999, "at least", 0.6, 0.3, unit="share").text
        == "kept: 59.9%, below the limit 60%"
    )
    assert (
        check_of("x", 0.150057698, "at most", 0.15, 0.5, unit="deg").text
        == "x: 0.151 deg, above the limit 0.15 deg"
    )
    assert (
        check_of("x", 0.2, "at most", 0.15, 0.5, unit="deg").text
        == "x: 0.2 deg, above the limit 0.15 deg"
    )
    assert beside(0.14999, 0.15, "deg") == "0.149 deg"
    assert beside(-0.2001, -0.2, "share") == "-20.1%"
    assert check_of("x", 1.0, "at most", 1.0, 2.0, unit="m").status == "PASS"


@pytest.mark.parametrize("seed", range(20))
def test_numbers_on_two_sides_of_a_limit_are_never_printed_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    limit = float(10.0 ** rng.uniform(-6, 6))
    for factor in 1.0 + 10.0 ** rng.uniform(-9, 0, 50):
        for value in (limit * factor, limit / factor):
            text = beside(value, limit, "deg")
            assert text != in_unit(limit, "deg")
            digits = text.split()[0].split("e")[0].replace(".", "").lstrip("0")
            assert len(digits.rstrip("0")) <= 3 or float(text.split()[0]) >= 1000


FEW_FRAMES = threshold("frames").check(2)
ODD = threshold("z_score").check(12.0)


def test_a_wide_error_bar_and_few_frames_cannot_tell() -> None:
    for verdict in (
        Verdict((), ErrorProbability(0.001, 0.05)),
        Verdict(
            (ODD,), ErrorProbability(0.001, 0.05)
        ),  # the error bar leaves more doubt than the checks
        Verdict((FEW_FRAMES,), ErrorProbability(0.01)),
        Verdict((FEW_FRAMES,), ErrorProbability(0.001)),
        Verdict((FEW_FRAMES,)),
    ):
        assert (verdict.status, verdict.cannot_tell) == ("WARN", True)
