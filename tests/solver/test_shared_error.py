"""The error that all frames share, and what cameras see in common reveals of its size."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibgraph import MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.config import Config
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import relative_covariance, relative_transform
from calibgraph.solver.camera_pairs import pair_terms
from calibgraph.solver.curvature import Curvature
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.pair_refinement import PairFit, fit_pairs, pair_sigmas
from calibgraph.solver.shared_error import (
    error_between,
    shared_scatter,
    shared_variance_ratio,
)
from calibgraph.trust.evidence import Evidence
from factors import pose_sigmas
from tests.solver.pairs import simulated_pairs

FINDINGS = MatcherFindings(systematic_rotation_rad=2e-3, systematic_translation_m=0.03)
EACH = pose_sigmas(rotation_rad=2e-3, translation_m=0.03) ** 2
FRAMES = 6


def alone(rig: Rig) -> Curvature:
    """Of correspondences that tie each camera by itself."""
    own = np.diag(np.tile([4e6, 3e6, 2e6, 9e4, 8e4, 7e4], len(rig.cameras)))
    return Curvature(own, np.zeros_like(own), own)


def test_every_camera_has_it_and_half_of_its_variance_is_that_of_the_whole_cloud(
    pair: Rig,
) -> None:
    bent = alone(pair)
    joint = bent.sandwich(shared_scatter(FINDINGS, pair.T_camera_lidar, bent, {}))
    assert np.diag(joint)[:3] == pytest.approx(EACH[:3], rel=1e-9)
    lever_m2 = 2e-3**2 / 2  # the cloud turns about the LiDAR, under a metre from the cameras
    for rows in (slice(3, 6), slice(9, 12)):
        assert (np.diag(joint)[rows] >= 0.999 * EACH[3:]).all()
        assert (np.diag(joint)[rows] <= EACH[3:] + lever_m2).all()
    relative = relative_covariance(
        joint, 0, 1, relative_transform(*(pair.T_camera_lidar[n] for n in ("right", "left")))
    )
    # What both share is not between them: two halves are left of two whole ones.
    assert np.diag(relative)[:3] == pytest.approx(EACH[:3], rel=1e-9)


def test_the_part_of_a_place_does_not_fall_with_the_number_of_its_frames(pair: Rig) -> None:
    findings = MatcherFindings(place_variance=4.0)
    found = []
    for count in (1, 10):
        own = count * alone(pair).of_correspondences
        bent = Curvature(own, np.zeros_like(own), own)
        frames = dict.fromkeys(pair.cameras, float(count))
        found.append(bent.sandwich(shared_scatter(findings, pair.T_camera_lidar, bent, frames)))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12, atol=1e-20)
    np.testing.assert_allclose(
        found[0], 4 * np.linalg.inv(alone(pair).of_correspondences), rtol=1e-9, atol=1e-20
    )


def test_the_error_of_images_is_between_cameras_that_share_features_alone(pair: Rig) -> None:
    terms, T = pair_terms(pair, simulated_pairs(pair), Config()), pair.T_camera_lidar
    assert not error_between(T, ()).any()
    relative = relative_covariance(
        error_between(T, terms), 0, 1, relative_transform(T["right"], T["left"])
    )
    # Half of the pair's variance is in the left camera, half a metre away, which adds to it.
    own = pair_sigmas()
    assert np.sqrt(np.diag(relative)) == pytest.approx(own, abs=0.5 * own[0])


@pytest.mark.parametrize("size", [2.0, 4.0])
def test_its_size_is_found_from_what_cameras_see_in_common(mixed_rig: Rig, size: float) -> None:
    """Cameras displaced at random by so many times their covariance, images that are exact."""
    rng = np.random.default_rng(0)
    covariance = np.diag(np.tile(EACH, 3))
    fits, found = fits_of(mixed_rig), []
    for _ in range(200):
        own = {
            name: gtsam.Pose3.Expmap(size * np.sqrt(EACH) * rng.standard_normal(6)).matrix() @ T
            for name, T in mixed_rig.T_camera_lidar.items()
        }
        found.append(shared_variance_ratio(own, covariance, fits))
    # Two of the three cameras are tied: six degrees of freedom, and six of what is usual.
    expected = (6 + 6 * size**2) / 12
    spread = 6 * size**2 * np.sqrt(2 / 6) / 12 / np.sqrt(200)
    assert np.mean(found) == pytest.approx(expected, rel=0.05, abs=4 * spread)


def fits_of(rig: Rig) -> list[PairFit]:
    """Where exact images place the cameras."""
    held = np.array([np.diag(EACH)] * len(rig.cameras))
    return fit_pairs(rig, simulated_pairs(rig), Config(), held)


def test_it_is_never_taken_for_less_than_usual(pair: Rig) -> None:
    covariance = np.diag(np.tile(EACH, 2))
    assert shared_variance_ratio(pair.T_camera_lidar, covariance, fits_of(pair)) == 1.0


def test_without_tied_cameras_it_is_as_usual(pair: Rig) -> None:
    assert shared_variance_ratio(pair.T_camera_lidar, np.eye(12), ()) == 1.0


def test_a_displaced_camera_widens_the_error_bars(pair: Rig) -> None:
    """The matches of one camera are displaced by 12 cm, which images of both show."""
    table = simulate_correspondences(
        pair, frames=FRAMES, errors=MatcherErrors(outlier_share=0.1), seed=0
    )
    metadata = {"systematic_rotation_rad": 1e-3, "systematic_translation_m": 0.01}
    moved = table.points_lidar_m.copy()
    moved[table.camera_index == table.cameras.index("right")] += [0.0, 0.12, 0.0]
    widths = []
    for points in (table.points_lidar_m, moved):
        given = replace(table, points_lidar_m=points, metadata=metadata)
        solution = solve_joint(pair, given, camera_matches=simulated_pairs(pair))
        evidence = Evidence(solution, guess=pair)
        covariance = evidence.covariance_of("right")
        assert covariance is not None
        widths.append(float(np.sqrt(covariance[3, 3])))
        errors = [
            np.linalg.norm(solution.T_camera_lidar[n][:3, 3] - pair.T_camera_lidar[n][:3, 3])
            for n in pair.cameras
        ]
    assert max(errors) > 0.02
    assert widths[1] > 2 * widths[0]
