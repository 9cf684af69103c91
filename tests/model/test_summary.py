"""A verdict in few words: reasons by cause, what to do, the rest folded."""

from __future__ import annotations

from dataclasses import replace

import pytest

from calibgraph.model.error_sources import (
    COMMON,
    ESTIMATED,
    LENSES,
    MATCHES,
    MOST_TIMES,
    UNMODELLED,
    ErrorSources,
)
from calibgraph.model.summary import LEAST, summarize
from calibgraph.model.verdict import Check, ErrorProbability, Verdict
from calibgraph.trust.thresholds import threshold

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
    verdict = of_kinds("competing_solution", "frames", "lens", "own_clouds", "guess_rotation")
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
        (ESTIMATED, "Estimate fewer parts of the lens (--estimate)"),
        (LENSES, "State how well lenses and clocks are known"),
        (UNMODELLED, "Leave preset out"),
    ],
)
def test_a_wide_bar_advises_on_its_largest_source(source: str, expected: str) -> None:
    """The lenses of a mount are uncertain though nothing of them is estimated."""
    shares = {source: 0.9, COMMON: 0.1}
    wide = replace(WIDE, rotation=shares, translation=shares)
    unsure = {"left": Verdict((), ErrorProbability(0.0, 0.1))}
    (action,) = summarize(unsure, sources={"left": wide}).actions
    assert action.startswith(expected)
