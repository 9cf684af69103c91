"""The error that all frames share: of each camera alone, or of those that images tie together."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Rig
from calibgraph.model.config import Config
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import relative_covariance, relative_transform
from calibgraph.solver.camera_pairs import pair_terms
from calibgraph.trust.shared_error import (
    PAIR_SIGMA_M,
    PAIR_SIGMA_RAD,
    shared_covariance,
    tied_cameras,
)
from factors import pose_sigmas
from tests.solver.test_camera_pairs import simulated_pairs

FINDINGS = MatcherFindings(systematic_rotation_rad=2e-3, systematic_translation_m=0.03)
EACH = pose_sigmas(rotation_rad=2e-3, translation_m=0.03) ** 2


def test_without_pairs_every_camera_has_an_error_of_its_own(mixed_rig: Rig) -> None:
    joint = shared_covariance(FINDINGS, mixed_rig.T_camera_lidar)
    np.testing.assert_allclose(joint, np.diag(np.tile(EACH, 3)), rtol=1e-12, atol=1e-20)


def test_tied_cameras_share_it_and_their_pair_does_not_have_it(pair: Rig) -> None:
    T = pair.T_camera_lidar
    terms = pair_terms(pair, simulated_pairs(pair), Config())
    joint = shared_covariance(FINDINGS, T, pairs=terms)
    relative = relative_covariance(joint, 0, 1, relative_transform(T["right"], T["left"]))
    own = pose_sigmas(rotation_rad=PAIR_SIGMA_RAD, translation_m=PAIR_SIGMA_M)
    # Half of the pair's variance is in the left camera, half a metre away, which adds to it.
    lever_m = 0.5 * PAIR_SIGMA_RAD
    assert np.sqrt(np.diag(relative)) == pytest.approx(own, abs=lever_m)
    for rows in (slice(0, 6), slice(6, 12)):
        assert (np.diag(joint)[rows] >= 0.999 * EACH).all()
        assert (np.diag(joint)[rows] < 1.2 * EACH).all()


def test_only_cameras_with_enough_in_common_are_tied(pair: Rig, mixed_rig: Rig) -> None:
    terms = pair_terms(pair, simulated_pairs(pair), Config())
    few = tuple(term.select(np.arange(20)) for term in terms)
    assert tied_cameras(["left", "right"], terms) == [["left", "right"]]
    assert tied_cameras(["left", "right"], few) == [["left"], ["right"]]
    three = pair_terms(mixed_rig, simulated_pairs(mixed_rig), Config())
    assert sorted(map(sorted, tied_cameras(list(mixed_rig.cameras), three))) == [
        ["front", "wide"], ["side"],
    ]  # fmt: skip
