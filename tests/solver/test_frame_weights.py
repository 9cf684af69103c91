"""Weights from residuals: frames that a matcher saw wrongly, confidences that say something."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import (
    Config,
    MatcherErrors,
    Rig,
    evaluate,
    perturb,
    simulate_correspondences,
    solve,
)
from calibgraph.model.correspondences import concatenate
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.solver.frame_weights import confidence_sigmas
from calibgraph.solver.joint import solve_joint

STUCK = MatcherErrors(
    noise_px=1.0,
    frame_noise_px=0.3,
    outlier_share=0.2,
    stuck_share=0.6,
    stuck_pose=PoseSpread((0.5, 0.5, 0.5), (0.3, 0.3, 0.6)),
)
GOOD = replace(STUCK, stuck_share=0.0)


def errors_of(rig: Rig, errors: MatcherErrors, *, learnt: bool, seed: int) -> list[float]:
    """Error of every camera [deg], from 20 deg and 1.5 m off, over 20 frames."""
    table = simulate_correspondences(rig, frames=20, matches=300, errors=errors, seed=seed)
    guess = perturb(rig, rotation_deg=20, translation_m=1.5, seed=seed)
    found = solve_joint(guess, table, Config(learnt_weights=learnt)).solved_rig
    return [error.rotation_error_deg for error in evaluate(found, rig).cameras.values()]


@pytest.mark.slow
def test_a_majority_of_frames_that_are_stuck_elsewhere_seldom_decides(pair: Rig) -> None:
    """70 % of frames lie about one wrong pose, 0.5 deg and 0.6 m away; 16 draws of a camera."""
    most = replace(STUCK, stuck_share=0.7)
    wrong = [
        sum(e > 0.1 for seed in range(8) for e in errors_of(pair, most, learnt=learnt, seed=seed))
        for learnt in (True, False)
    ]
    assert wrong[0] <= 3 < wrong[1]


def test_good_frames_all_count(pair: Rig) -> None:
    table = simulate_correspondences(pair, frames=20, matches=300, errors=GOOD)
    found = solve_joint(pair, table)
    for counts in found.counts.values():
        assert counts["outlier_frames"] <= 2
        assert counts["frames"] == 20


def test_frames_with_few_matches_neither_rule_nor_are_called_apart(pair: Rig) -> None:
    """Six unknowns of a frame's own explain three matches exactly: that is not their merit."""
    noise = MatcherErrors(noise_px=1.0, outlier_share=0.0)
    dense = simulate_correspondences(pair, frames=12, matches=300, errors=noise, seed=1)
    sparse = simulate_correspondences(pair, frames=100, matches=3, errors=noise, seed=2)
    table = concatenate([dense, replace(sparse, frame=sparse.frame + 12)])
    learnt = solve_joint(pair, table)
    plain = solve_joint(pair, table, Config(learnt_weights=False))
    for counts in learnt.counts.values():
        assert counts["outlier_frames"] <= 3
    worst = [
        max(e.rotation_error_deg for e in evaluate(found.solved_rig, pair).cameras.values())
        for found in (learnt, plain)
    ]
    assert worst[0] < 1.3 * worst[1] + 0.001


def test_a_minority_that_decides_is_worth_a_warning(pair: Rig) -> None:
    errors = replace(STUCK, stuck_share=0.75)
    table = simulate_correspondences(pair, frames=30, matches=200, errors=errors, seed=3)
    result = solve(pair, table)
    apart = [counts["outlier_frames"] / counts["frames"] for counts in result.counts.values()]
    assert max(apart) > 0.35
    assert result.verdict.status != "PASS"
    assert any("outlier frames" in reason for reason in result.verdict.reasons)


class TestConfidences:
    def test_what_they_are_worth_is_learnt(self) -> None:
        """1 px at confidence 1, 4 px at 0: within the scatter of spreads of 1000 matches, 3 %."""
        rng = np.random.default_rng(0)
        confidence = rng.uniform(0, 1, 20_000)
        sigma = 4.0 - 3.0 * confidence
        sizes = sigma * np.hypot(*rng.standard_normal((2, 20_000))) / 1.17741
        learnt = confidence_sigmas(sizes, confidence)
        ratio = learnt / sigma
        inner = (confidence > 0.05) & (confidence < 0.95)
        np.testing.assert_allclose(ratio[inner], np.median(ratio), rtol=0.12)

    def test_they_are_not_believed_where_they_say_nothing(self) -> None:
        rng = np.random.default_rng(0)
        sizes = np.hypot(*rng.standard_normal((2, 20_000)))
        learnt = confidence_sigmas(sizes, rng.uniform(0, 1, 20_000))
        assert learnt.max() / learnt.min() < 1.1

    def test_they_never_count_the_wrong_way(self) -> None:
        rng = np.random.default_rng(0)
        confidence = rng.uniform(0, 1, 5000)
        sizes = (1 + confidence) * np.hypot(*rng.standard_normal((2, 5000)))
        learnt = confidence_sigmas(sizes, confidence)
        assert (np.diff(learnt[np.argsort(confidence)]) <= 1e-12).all()

    @pytest.mark.parametrize("count", [0, 10, 199])
    def test_few_matches_are_alike(self, count: int) -> None:
        rng = np.random.default_rng(0)
        np.testing.assert_array_equal(
            confidence_sigmas(rng.random(count), rng.random(count)), np.ones(count)
        )
