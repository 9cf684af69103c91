"""Settings, the verdict, and its few words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import Check, Verdict, preset
from calibgraph.model.error_sources import (
    COMMON,
    ESTIMATED,
    LENSES,
    MATCHES,
    MOST_TIMES,
    ErrorSources,
)
from calibgraph.model.summary import LEAST, summarize
from calibgraph.model.verdict import ErrorProbability, Threshold, beside, in_unit, rig_verdict
from calibgraph.trust.thresholds import threshold


def test_presets_use_the_papers_numbers() -> None:
    kitti, walkley = preset("kitti"), preset("walkley")
    assert (kitti.prior_weight, kitti.relative_prior_weight) == (1, 5)
    assert (kitti.loss_scale_px, kitti.gate_px, kitti.confidence_min) == (4, 3, 0.1)
    assert (walkley.prior_weight, walkley.relative_prior_weight) == (2, 10)
    assert (walkley.loss_scale_px, walkley.gate_px, walkley.confidence_min) == (8, 16, 0.2)
    assert walkley.confidence_weights
    assert not kitti.confidence_weights


def check_of(name: str, value: float, *limits: float, unit: str = "") -> Check:
    return Threshold(name, name, *limits, unit, "").check(value)


def test_the_worst_check_decides_and_its_reason_comes_first() -> None:
    verdict = Verdict(
        (
            check_of("a", 2, 1, 3, unit="m"),
            check_of("b", 0, 1, 3, unit="m"),
            check_of("c", 0, 2, 1),
        )
    )
    assert verdict.status == "FAIL"
    assert [reason[0] for reason in verdict.reasons] == ["c", "a"]
    assert rig_verdict({"front": verdict}).reasons[0] == "front: c: 0, below the limit 1"


def test_a_number_next_to_its_limit_is_told_from_it_in_three_digits() -> None:
    above = "above the limit 0.15 deg"
    for check, text in (
        (check_of("x", 0.59999, 0.6, 0.3, unit="share"), "59.9%, below the limit 60%"),
        (check_of("x", 0.1500577, 0.15, 0.5, unit="deg"), f"0.151 deg, {above}"),
        (check_of("x", 0.2, 0.15, 0.5, unit="deg"), f"0.2 deg, {above}"),
    ):
        assert check.text == f"x: {text}"
    assert beside(0.14999, 0.15, "deg") == "0.149 deg"
    assert beside(-0.2001, -0.2, "share") == "-20.1%"
    assert check_of("x", 1.0, 1.0, 2.0, unit="m").status == "PASS"


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
        Verdict((ODD,), ErrorProbability(0.001, 0.05)),  # which leaves more doubt than the check
        Verdict((FEW_FRAMES,), ErrorProbability(0.01)),
        Verdict((FEW_FRAMES,), ErrorProbability(0.001)),
        Verdict((FEW_FRAMES,)),
    ):
        assert (verdict.status, verdict.cannot_tell) == ("WARN", True)


FAILED = Check("convergence", "FAIL", "the optimizer did not converge")


def of_kinds(*kinds: str) -> Verdict:
    """One WARN of each kind."""
    return Verdict(tuple(Check(kind, "WARN", f"{kind} is odd", kind=kind) for kind in kinds))


def test_a_check_that_fails_and_warns_is_one_reason_the_worst_camera_first() -> None:
    verdicts = {"left": of_z_score(14.0), "right": of_z_score(5.0)}
    (reason,) = summarize(verdicts).reasons
    assert (reason.status, reason.cameras) == ("FAIL", ("right", "left"))
    assert reason.text.startswith(
        "z-score of image and cloud: right 5 (FAIL: limit 8); left 14 (WARN: limit 15): "
    )


def of_z_score(value: float) -> Verdict:
    """One check."""
    return Verdict((threshold("z_score").check(value),))


def test_a_fail_comes_before_what_explains_it_if_that_only_warns() -> None:
    verdict = of_kinds("competing_solution", "frames", "lens", "own_clouds", "guess_translation")
    summary = summarize({"left": Verdict((*verdict.checks, FAILED))}, {"left": ("loose height",)})
    assert [reason.cause for reason in summary.reasons] == ["solver", "guess", "time"]
    assert len(summary.reasons) == len(summary.actions) == LEAST
    assert [o.cause for o in summary.others] == ["lens", "matches", "data", ""]
    assert summary.others[-1].text == "loose height"


def test_cannot_tell_is_a_reason_and_no_status() -> None:
    summary = summarize({"left": Verdict((), ErrorProbability(0.001, 0.3))})
    assert (summary.status, summary.cannot_tell) == ("WARN", True)
    (reason,) = summary.reasons
    assert reason.text.startswith("cannot tell: ") and "0.5 deg or 10 cm" in reason.text
    assert (
        summary.error_probability
        == "off by more than 0.5 deg or 10 cm with a probability: left 30%"
    )


def test_over_99_percent_is_a_fail_even_by_the_error_bar_alone() -> None:
    verdicts = {"left": Verdict((), ErrorProbability(0.0, 0.995)), "right": of_kinds("lens")}
    summary = summarize(verdicts, sources={"left": WIDE})
    assert (summary.status, summary.cannot_tell) == ("FAIL", False)
    assert summary.reasons[0].status == "FAIL" and "too wide" in summary.reasons[0].text
    assert summary.actions[0].startswith("left: Tolerate more") and summary.error_bar == ""


WIDE = ErrorSources(
    rotation_deg=0.3,
    translation_cm=2.0,
    rotation={COMMON: 0.9, MATCHES: 0.1},
    translation={COMMON: 0.9, MATCHES: 0.1},
    forecast={2: (0.29, 1.9), MOST_TIMES: (0.285, 1.8)},
)


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (ESTIMATED, "Estimate fewer parts of the lens"),
        (LENSES, "State how well lenses and clocks are known"),
    ],
)
def test_a_wide_bar_advises_on_its_largest_source(source: str, expected: str) -> None:
    """The lenses of a mount are uncertain though nothing of them is estimated."""
    shares = {source: 0.9, COMMON: 0.1}
    wide = replace(WIDE, rotation=shares, translation=shares)
    unsure = {"left": Verdict((), ErrorProbability(0.0, 0.1))}
    (action,) = summarize(unsure, sources={"left": wide}).actions
    assert expected in action
