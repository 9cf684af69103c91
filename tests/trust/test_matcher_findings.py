"""The verdict on a table's findings: the same for a matcher's own run and a later solve."""

from __future__ import annotations

from dataclasses import replace

import pytest

import calibgraph
from calibgraph import Correspondences, Rig

STATED = {"systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0}


@pytest.fixture
def table(pair: Rig) -> Correspondences:
    return calibgraph.simulate_correspondences(pair, frames=8, matches=200)


@pytest.mark.parametrize(
    ("findings", "status"),
    [
        ({}, "PASS"),
        ({"start_dependence": 0.1, "memorization": 0.1, "failed_share": 0.1}, "PASS"),
        ({"start_dependence": 0.3}, "WARN"),
        ({"start_dependence": 0.9}, "FAIL"),
        ({"start_dependence": float("nan")}, "FAIL"),
        ({"memorization": 0.4}, "WARN"),
        ({"memorization": 1.0}, "FAIL"),
        ({"memorization": -0.5}, "PASS"),
        ({"failed_share": 0.5}, "WARN"),
        ({"failed_share": 1.0}, "FAIL"),
    ],
)
def test_findings_decide_the_verdict_of_their_camera(
    pair: Rig, table: Correspondences, findings: dict[str, float], status: str
) -> None:
    metadata = STATED | {key: {"left": value} for key, value in findings.items()}
    verdicts = calibgraph.solve(pair, replace(table, metadata=metadata)).camera_verdicts
    assert verdicts["left"].status == status
    found = [check for check in verdicts["left"].checks if check.status != "PASS"]
    assert len(found) == (status != "PASS")
    assert verdicts["right"].status == "PASS"


@pytest.mark.parametrize("nonsense", [{"left": "high"}, {"left": True}, 3, [1]])
def test_malformed_findings_are_refused(
    pair: Rig, table: Correspondences, nonsense: object
) -> None:
    with pytest.raises(calibgraph.CorrespondenceError, match="memorization"):
        calibgraph.solve(pair, replace(table, metadata={"memorization": nonsense}))


def test_a_matchers_own_error_is_reported_once(pair: Rig) -> None:
    """It is part of the error bar; where there is none, it stands alone."""
    for terms, reason in (
        ("full", "sigma: rotation"),
        ("priors", "error that the matcher's frames share: rotation"),
    ):
        table = calibgraph.simulate_correspondences(pair, frames=8, matches=200)
        with_error = replace(table, metadata={"systematic_rotation_rad": 0.02})
        verdict = calibgraph.solve(pair, with_error, terms=terms).camera_verdicts["left"]
        assert verdict.status != "PASS"
        checks = [check for check in verdict.checks if check.status == "FAIL"]
        rotations = [check.text for check in checks if "rotation" in check.text]
        assert len(rotations) == 1 and rotations[0].startswith(reason)


def test_an_error_that_is_in_the_error_bar_is_not_listed_as_zero(pair: Rig) -> None:
    table = calibgraph.simulate_correspondences(pair, frames=8, matches=200)
    with_error = replace(table, metadata={"systematic_rotation_rad": 0.001})
    verdict = calibgraph.solve(pair, with_error).camera_verdicts["left"]
    assert not [check.name for check in verdict.checks if "frames share" in check.name]
