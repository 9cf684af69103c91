"""The error bar of a result, and images of two cameras against their calibration."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray

import calibgraph
from calibgraph import Calibration, MatcherErrors, Rig, perturb, simulate_correspondences, solve
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.pair_refinement import fit_pairs, place_pairs
from calibgraph.solver.pairs import pair_terms
from calibgraph.trust.agreement import Apart, check_agreement, pair_agreement
from calibgraph.trust.evidence import Evidence
from factors import pose_sigmas
from tests.conftest import stereo_relative_pose
from tests.draws.lenses import with_known_lenses
from tests.solver.test_camera_pairs import simulated_pairs
from tests.trust.conftest import named, simulated

Array = NDArray[np.float64]


def tied(rig: Rig, *, rotation_deg: float, translation_m: float) -> Rig:
    """With a measured relative pose of right and left."""
    sigmas = np.radians(rotation_deg), translation_m
    measured = stereo_relative_pose(rig, "right", "left", sigmas=sigmas)
    return rig.model_copy(update={"relative_poses": (measured,)})


def test_the_covariance_has_full_rank_with_fewer_frames_than_numbers(mixed_rig: Rig) -> None:
    result = solve(mixed_rig, simulated(mixed_rig, frames=5))
    assert np.linalg.eigvalsh(result.joint_covariance)[0] > 0


@pytest.mark.parametrize("frames", [1, 2, 4])
def test_the_error_bar_of_few_frames_is_wide(pair: Rig, frames: int) -> None:
    """In the mean over its axes at least as the root of their number; and never a PASS."""
    rig = with_known_lenses(pair)
    few, many = (solve(rig, simulated(rig, frames=n)) for n in (frames, 40))
    for name in rig.cameras:
        narrow, wide = (result.sigmas(name) for result in (many, few))
        for one, other in zip(narrow, wide, strict=True):
            assert np.exp(np.log(other / one).mean()) > 0.8 * np.sqrt(40 / frames)
    assert few.verdict.status != "PASS"
    assert any("mostly a default" in reason for reason in few.verdict.reasons)


def test_the_sigmas_of_a_relative_pose_are_in_the_error_bar(pair: Rig) -> None:
    """Of a camera without correspondences, they are nearly all of it."""
    table = simulated(pair, frames=10).of_camera("left")
    result = solve(tied(pair, rotation_deg=2.9, translation_m=0.3), table)
    sigmas = result.sigmas("right")
    assert sigmas[0] == pytest.approx([2.9] * 3, rel=0.01)
    assert sigmas[1] == pytest.approx([30] * 3, rel=0.1)
    of_left = result.sigmas("left")
    assert of_left is not None and of_left[0].max() < 0.1


def test_an_error_shared_by_all_frames_moves_a_camera_without_correspondences_with_its_pair(
    pair: Rig,
) -> None:
    rig = tied(pair, rotation_deg=0.01, translation_m=0.001)
    table = simulated(pair, frames=10).of_camera("left")
    findings = table.metadata | {"systematic_rotation_rad": 0.01, "systematic_translation_m": 0.1}
    table = table.with_metadata(findings)
    covariance = Evidence(solve_joint(rig, table), rig).joint_covariance
    sigmas = np.sqrt(np.diag(covariance)).reshape(-1, 6)
    assert sigmas[1, :3] == pytest.approx([0.01] * 3, rel=0.05)  # not more: the pair is rigid
    assert sigmas[1, 3:] == pytest.approx([0.1] * 3, rel=0.05)


@pytest.mark.parametrize(("turned_deg", "groups"), [(0, [("left", "right")]), (30, None)])
def test_a_relative_pose_ties_cameras_unless_matches_contradict_it(
    pair: Rig, turned_deg: float, groups: list[tuple[str, ...]] | None
) -> None:
    measured = tied(pair, rotation_deg=0.02, translation_m=0.003).relative_poses[0]
    turn = gtsam.Pose3(gtsam.Rot3.Ry(np.radians(turned_deg)), np.zeros(3)).matrix()
    measured = measured.model_copy(update={"T_a_b": measured.T_a_b @ turn})
    rig = pair.model_copy(update={"relative_poses": (measured,)})
    found = Evidence(solve_joint(rig, simulated(rig, frames=10)), rig).tied
    assert found == (groups or [("left",), ("right",)])


SIGMAS = pose_sigmas(rotation_rad=np.radians(0.05), translation_m=0.01)


def agreement(rig: Rig, table: CameraMatches) -> Apart:
    terms, held = pair_terms(rig, table), np.array([np.diag(SIGMAS**2)] * 2)
    T = rig.T_camera_lidar
    (fit,) = fit_pairs(terms, T, held, place_pairs(terms, T))
    return pair_agreement(rig, fit, np.diag(np.tile(SIGMAS**2, 2)))


def test_a_right_calibration_agrees(pair: Rig) -> None:
    """Differences are within the sigmas that went in: 0.05 deg and 1 cm per camera and axis."""
    rng = np.random.default_rng(0)
    table = simulated_pairs(pair)
    sigmas = []
    for _ in range(10):
        twists = rng.normal(0, np.tile(SIGMAS, 2)).reshape(2, 6)
        moved = {
            name: gtsam.Pose3.Expmap(twist).matrix() @ T
            for twist, (name, T) in zip(twists, pair.T_camera_lidar.items(), strict=True)
        }
        degrees, centimetres, largest = agreement(pair.moved_to(moved), table)
        sigmas.append(largest)
        assert degrees < 0.4 and centimetres < 6
    # The largest of six standard Gaussians is 0.5 to 3 in 99 of 100 draws.
    assert 0.5 < np.median(sigmas) < 2.2 and max(sigmas) < 3.5


def test_a_moved_camera_disagrees_by_its_motion(pair: Rig) -> None:
    moved = perturb(pair, rotation_deg=0.5, translation_m=0.1, seed=4).T_camera_lidar["right"]
    degrees, _, sigmas = agreement(pair.moved_to({"right": moved}), simulated_pairs(pair))
    assert degrees == pytest.approx(0.5, abs=0.1)
    assert sigmas > 4


def test_swapped_images_disagree_by_twice_the_baseline(pair: Rig) -> None:
    table = simulated_pairs(pair)
    swapped = replace(table, pixels_px=np.ascontiguousarray(table.pixels_px[:, ::-1]))
    _, centimetres, sigmas = agreement(pair, swapped)
    assert centimetres == pytest.approx(100, abs=10)
    assert sigmas > 10


def judged(truth: Rig, seen: Rig, matches: CameraMatches | None) -> Calibration:
    """A result of correspondences that fit one rig, and of images of another, the true one."""
    shared = {"systematic_rotation_rad": np.radians(0.09), "systematic_translation_m": 0.02}
    table = simulate_correspondences(seen, frames=8, errors=MatcherErrors(outlier_share=0.1))
    table = replace(table, metadata={**table.metadata, **shared})
    return calibgraph.solve(truth, table, camera_matches=matches)


def test_the_verdict_names_a_pair_whose_images_disagree(pair: Rig) -> None:
    right = judged(pair, pair, simulated_pairs(pair))
    moved = perturb(pair, rotation_deg=0.8, translation_m=0.0, seed=1).T_camera_lidar["right"]
    wrong = judged(pair, pair.moved_to({"right": moved}), simulated_pairs(pair))
    for name in pair.cameras:
        (passed,) = named(right, name, "by images")
        assert passed.status == "PASS" and passed.value is not None and passed.value < 1
        (failed,) = named(wrong, name, "by images")
        assert failed.status != "PASS"
        assert "contradict each other on the pose of left to right" in failed.text


def test_a_camera_that_disagrees_with_all_its_neighbours_is_the_one_that_is_wrong() -> None:
    apart = {("a", "b"): (0.3, 10.0, 4.2), ("b", "c"): (0.3, 10.0, 3.8), ("c", "d"): (0, 0, 0.5)}
    blamed, spared = (check_agreement(("a", "b"), name, apart) for name in ("b", "a"))
    assert blamed.status == "FAIL" and blamed.severity > 2
    assert spared.status == "WARN" and spared.severity == 1.0  # never PASS: nobody vouches for it
    assert "by its other pairs (3.8 sigma) it is b that is wrong" in spared.text
    assert check_agreement(("b", "c"), "c", apart).severity == 1.0
    assert check_agreement(("c", "d"), "d", apart).status == "PASS"


def test_of_two_cameras_either_may_be_wrong() -> None:
    pair, apart = ("a", "b"), {("a", "b"): (0.3, 10.0, 4.2)}
    assert [check_agreement(pair, name, apart).status for name in pair] == ["FAIL", "FAIL"]
    nearly = {**apart, ("b", "c"): (0.3, 10.0, 1.5)}  # a neighbour of b agrees
    assert check_agreement(pair, "a", nearly).status == "FAIL"


@pytest.mark.parametrize(("tied", "metres"), [(False, 0.0), (False, 0.02), (True, 0.0)])
def test_cameras_that_end_at_one_pose_are_no_pass_unless_the_rig_ties_them(
    pair: Rig, tied: bool, metres: float
) -> None:
    T = pair.T_camera_lidar["left"].copy()
    T[0, 3] += metres
    rig = pair.moved_to({"right": T})
    table = simulate_correspondences(rig, frames=8, matches=200)
    if tied:
        rig = rig.model_copy(update={"relative_poses": (stereo_relative_pose(rig),)})
    verdicts = calibgraph.solve(rig, table).camera_verdicts
    asked = not tied and metres == 0
    for verdict in verdicts.values():
        assert [check.kind for check in verdict.checks if check.kind == "one_pose"] == (
            ["one_pose"] if asked else []
        )
        assert not (asked and verdict.status != "WARN")
