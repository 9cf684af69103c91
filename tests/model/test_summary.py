"""A verdict in few words: reasons by cause, what to do, the rest folded."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

import calibgraph
from calibgraph.model.causes import CAUSES, cause_of
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
from calibgraph.model.verdict import BRIGHTNESS, COMMON_ERROR, Check, ErrorProbability, Verdict
from calibgraph.trust.lens_parameter import LENS_KINDS
from calibgraph.trust.thresholds import THRESHOLDS, threshold

FAILED = Check("convergence", "FAIL", "the optimizer did not converge")


def of_kinds(*kinds: str) -> Verdict:
    """One WARN of each kind."""
    return Verdict(tuple(Check(kind, "WARN", f"{kind} is odd", kind=kind) for kind in kinds))


def test_a_pass_has_no_reasons_and_nothing_to_do() -> None:
    summary = summarize({"left": Verdict((threshold("frames").check(9),), ErrorProbability(0.001))})
    assert summary.status == "PASS"
    assert (summary.error_probability, summary.reasons, summary.actions, summary.others) == (
        "",
        (),
        (),
        (),
    )


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


def test_sentences_that_differ_in_a_number_are_one_reason() -> None:
    def missed(value: float) -> Verdict:
        return Verdict((Check("search", "FAIL", f"not found (best {value}): give 6 more", value),))

    (reason,) = summarize({"left": missed(3.1), "right": missed(2.9)}).reasons
    assert (reason.cameras, reason.text) == (
        ("left", "right"), "not found (best 3.1, 2.9): give 6 more"
    )  # fmt: skip


def test_every_camera_has_its_own_reason_and_action() -> None:
    """A wrong centre is shown though causes of other cameras come before it."""
    wrong = {"left": ("search", "z_score"), "rear": ("guess_rotation", "time_offset"),
             "right": ("principal_point", "frames")}  # fmt: skip
    summary = summarize({name: of_kinds(*kinds) for name, kinds in wrong.items()})
    assert [(r.cameras, r.cause) for r in summary.reasons] == [
        (("left",), "guess"), (("rear",), "guess"), (("right",), "lens")
    ]  # fmt: skip
    assert [action.partition(":")[0] for action in summary.actions] == ["left", "rear", "right"]
    assert [r.cause for r in summary.others] == ["time", "agreement", "data"]


def test_a_fail_comes_before_what_explains_it_if_that_only_warns() -> None:
    verdict = of_kinds("competing_solution", "frames", "lens", "own_clouds", "guess_rotation")
    summary = summarize({"left": Verdict((*verdict.checks, FAILED))}, {"left": ("loose height",)})
    assert [reason.cause for reason in summary.reasons] == ["solver", "guess", "time"]
    assert len(summary.reasons) == len(summary.actions) == LEAST
    assert [o.cause for o in summary.others] == ["lens", "matches", "data", ""]
    assert summary.others[-1].text == "loose height"


def test_of_the_checks_of_one_cause_a_camera_has_the_worst_as_its_reason() -> None:
    mild, bad = (Check(kind, "WARN", f"{kind} is odd", value, 1.0, 2.0, kind=kind)
                 for kind, value in (("own_clouds", 1.1), ("time_offset", 1.9)))  # fmt: skip
    summary = summarize({"left": Verdict((mild, bad))})
    assert [reason.text for reason in summary.reasons] == ["time_offset is odd"]
    assert [other.text for other in summary.others] == ["own_clouds is odd"]


def test_an_action_is_stated_once() -> None:
    summary = summarize({"left": of_kinds("start_dependence"), "right": of_kinds("memorization")})
    assert len(summary.actions) == 1


def test_the_lens_parts_to_estimate_are_those_that_the_check_names() -> None:
    text = "a focal length 2 % longer: check the intrinsics; or run with --estimate lens,aspect"
    check = Check("focal length", "FAIL", text, kind="focal_length")
    (action,) = summarize({"left": Verdict((check,))}).actions
    assert action.endswith("estimate the lens: --estimate lens,aspect.")


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


def test_every_kind_of_check_has_a_cause() -> None:
    named = {kind for kind in (*LENS_KINDS, COMMON_ERROR, *(row.key for row in THRESHOLDS))}
    for path in Path(calibgraph.__file__).parent.rglob("*.py"):
        if "Check(" in (text := path.read_text()):
            nodes = ast.walk(ast.parse(text))
            named |= {kind for node in nodes if (kind := literal_name(node)) is not None}
    assert len(named) > len(THRESHOLDS) + len(LENS_KINDS)  # checks without a row were found
    assert {kind for kind in named if cause_of(kind) == "other"} == set()


def literal_name(node: ast.AST) -> str | None:
    """The name in a call of Check with a literal one; it is its kind, too."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Check":
        if any(keyword.arg == "kind" for keyword in node.keywords):
            return None
        first = node.args[0] if node.args else None
        return first.value if isinstance(first, ast.Constant) else None
    return None


WIDE = ErrorSources(
    rotation_deg=0.3,
    translation_cm=2.0,
    rotation={COMMON: 0.9, MATCHES: 0.1},
    translation={COMMON: 0.9, MATCHES: 0.1},
    forecast={2: (0.29, 1.9), MOST_TIMES: (0.285, 1.8)},
)


def test_what_to_do_about_a_wide_error_bar_follows_from_its_sources() -> None:
    unsure = {
        "left": Verdict((threshold("sigma_rotation").check(0.3),), ErrorProbability(0.001, 0.1))
    }
    summary = summarize(unsure, sources={"left": WIDE})
    assert summary.error_bar == (
        "Least certain: left, 0.3 deg (1 sigma). Measured relative_poses or priors would help most."
    )
    (action,) = summary.actions
    assert "0.28 deg of common error remain" in action or "0.29 deg of common error" in action
    few = replace(WIDE, forecast={2: (0.2, 1.5), 3: (0.14, 1.0), MOST_TIMES: (0.01, 0.1)})
    assert summarize(unsure, sources={"left": few}).actions == ("Record 3 times as many frames.",)


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


def test_a_failed_camera_has_no_error_bar_and_no_advice_about_it() -> None:
    checks = (threshold("competing_solution").check(9.0), threshold("sigma_rotation").check(9.0))
    summary = summarize({"left": Verdict(checks, ErrorProbability(0.9))}, sources={"left": WIDE})
    assert [reason.cause for reason in summary.reasons] == ["matches", "error bar"]
    assert summary.actions == (CAUSES["matches"].action,)
    assert summary.error_bar == ""


def test_a_doubt_without_a_check_beyond_its_limit_names_the_nearest_one() -> None:
    checks = (threshold("competing_solution").check(0.24), threshold("sigma_rotation").check(0.01))
    summary = summarize({"left": Verdict(checks, ErrorProbability(0.02))})
    (reason,) = summary.reasons
    assert (reason.status, reason.cause) == ("WARN", "matches")
    assert reason.text == (
        "no check is beyond its limit; nearest to it is "
        "matches of a competing solution over those of this one: 24%"
    )
    assert summary.actions == (CAUSES["matches"].action,)


def test_images_that_are_too_dark_are_the_only_reason_of_their_camera() -> None:
    dark = Check(BRIGHTNESS, "WARN", "the images of a are too dark: 13 of 255; expose longer")
    checks = (dark, *of_kinds("guess_rotation", "lens", "z_score", "range_rotation").checks)
    found = summarize({"a": Verdict(checks)})
    assert [reason.text for reason in found.reasons] == [dark.text]
    assert not found.others
