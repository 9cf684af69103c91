"""The error that all frames of a table share: stated by the table, its matcher, or the settings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from calibgraph import (
    Correspondences,
    MatcherErrors,
    Rig,
    simulate_correspondences,
    solve,
)
from calibgraph.model.config import Config
from calibgraph.model.error_components import error_components
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.verdict import COMMON_ERROR
from calibgraph.simulation.correspondences import PoseSpread

ZERO = {"systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0}


def table(rig: Rig, metadata: dict[str, Any]) -> Correspondences:
    return replace(simulate_correspondences(rig, frames=8, matches=200), metadata=metadata)


def common_checks(rig: Rig, found: Correspondences, config: Config | None = None) -> list[str]:
    result = solve(rig, found, config)
    return [c.text for c in result.camera_verdicts["left"].checks if c.kind == COMMON_ERROR]


@pytest.mark.parametrize("metadata", [{}, {"matcher": "mine"}, {"name": "picked by hand"}])
def test_a_table_that_states_none_is_no_pass(pair: Rig, metadata: dict[str, Any]) -> None:
    result = solve(pair, table(pair, metadata))
    assert result.verdict.status == "WARN" and result.verdict.cannot_tell
    (reason,) = result.summary.reasons
    assert reason.text.startswith("cannot tell: scatter only: ")
    assert reason.cameras == ("left", "right")
    assert any("common_deg and common_cm" in action for action in result.summary.actions)


@pytest.mark.parametrize("matcher", ["structure", "cmrnext"])
def test_a_known_matcher_has_its_usual_one(pair: Rig, matcher: str) -> None:
    usual = error_components().matchers[matcher]
    found = MatcherFindings.from_metadata({"matcher": matcher})
    assert found.systematic_rotation_rad == usual.systematic_rotation_rad
    assert found.place_variance == usual.place_variance
    assert not common_checks(pair, table(pair, {"matcher": matcher}))
    silent, known = (
        solve(pair, table(pair, metadata)).sigmas("left") for metadata in ({}, {"matcher": matcher})
    )
    assert silent is not None and known is not None
    assert known[0].max() > 3 * silent[0].max() and known[1].max() > 3 * silent[1].max()
    own = MatcherFindings.from_metadata({"matcher": matcher, **ZERO})
    assert own.systematic_sigmas == (0.0, 0.0) and own.place_variance == 0.0


def test_the_settings_state_it_for_a_table_that_does_not(pair: Rig) -> None:
    config = Config(common_deg=0.1, common_cm=2.0)
    sigmas = solve(pair, table(pair, {}), config).sigmas("left")
    assert sigmas is not None and sigmas[0].max() > 0.1 and sigmas[1].max() > 2.0
    assert not common_checks(pair, table(pair, {}), config)
    assert not common_checks(pair, table(pair, {}), Config(common_deg=0.0))


def test_simulated_matchers_state_it_where_they_have_none(pair: Rig) -> None:
    biased = MatcherErrors(bias_pose=PoseSpread(rotation_deg=(0.1, 0.1, 0.1)))
    for errors, states in ((MatcherErrors(), True), (biased, False)):
        found = simulate_correspondences(pair, frames=1, matches=50, errors=errors)
        assert found.findings.states_common_error == states
        kept = MatcherFindings.from_metadata(found.findings.to_metadata())
        assert kept.states_common_error == states
