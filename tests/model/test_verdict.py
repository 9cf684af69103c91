from __future__ import annotations

from collections.abc import Callable

import pytest

from calibgraph import Check, Verdict
from calibgraph.model.threshold import at_least, at_most
from calibgraph.model.verdict import ABOUT_THE_DATA, Doubt, rig_verdict
from calibgraph.trust.thresholds import threshold


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


FEW_FRAMES = threshold("frames").check(2)
ODD = threshold("z_score").check(12.0)


def test_a_wide_error_bar_and_few_frames_cannot_tell() -> None:
    for verdict in (
        Verdict((), Doubt(0.001, 0.05)),
        Verdict((ODD,), Doubt(0.001, 0.05)),  # the error bar leaves more doubt than the checks
        Verdict((FEW_FRAMES,), Doubt(0.01)),
        Verdict((FEW_FRAMES,), Doubt(0.001)),
        Verdict((FEW_FRAMES,)),
    ):
        assert (verdict.status, verdict.cannot_tell, verdict.label) == ("WARN", True, "CANNOT TELL")


def test_what_looks_odd_right_or_wrong_is_no_lack_of_data() -> None:
    for verdict, status in (
        (Verdict((ODD,), Doubt(0.05)), "WARN"),
        (Verdict((FEW_FRAMES, ODD), Doubt(0.05, 0.01)), "WARN"),
        (Verdict((FEW_FRAMES, ODD)), "WARN"),
        (Verdict((), Doubt(0.05)), "WARN"),
        (Verdict((), Doubt(0.001)), "PASS"),
        (Verdict((), Doubt(0.5, 0.6)), "FAIL"),
    ):
        assert (verdict.status, verdict.cannot_tell, verdict.label) == (status, False, status)
        assert not any("cannot tell" in reason for reason in verdict.reasons)


def test_a_rig_cannot_tell_if_none_of_its_cameras_looks_odd() -> None:
    unsure, odd = Verdict((), Doubt(0.001, 0.3)), Verdict((ODD,), Doubt(0.01))
    good, wrong = Verdict((), Doubt(0.001)), Verdict((), Doubt(0.9))
    assert rig_verdict({"a": unsure, "b": good}).cannot_tell
    for other in (odd, wrong):
        assert not rig_verdict({"a": unsure, "b": other}).cannot_tell


def test_kinds_of_checks_of_the_data_are_those_of_the_table_or_have_no_number() -> None:
    without_a_row = {"correspondences", "image evidence", "terms"}
    names = {"difference between even and odd frames"}
    assert threshold("halves_rotation").name in names
    for key in ABOUT_THE_DATA - without_a_row - names:
        assert threshold(key).key == key
