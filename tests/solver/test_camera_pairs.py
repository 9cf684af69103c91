"""What cameras see in common, in the solve: the relative pose, and what a wrong pose of A does."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

import calibgraph
from calibgraph import CorrespondenceError, MatcherErrors, Rig, perturb, simulate_correspondences
from calibgraph.graph.objective import pose_key
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.model.geometry import (
    pose_difference,
    relative_covariance,
    relative_transform,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.pairs import MIN_PAIR_MATCHES, PairTerm, pair_graph, pair_terms
from calibgraph.solver.solution import Solution
from calibgraph.solver.two_pass import optimize
from factors import pose_sigmas
from tests.conftest import points_in_front
from tests.draws.lenses import with_known_lenses

FRAMES = 8


def simulated_pairs(
    rig: Rig, *, count: int = 150, noise_px: float = 0.3, outliers: float = 0.1, seed: int = 0
) -> CameraMatches:
    """Features of the first two cameras on random planes, per frame; some without a plane."""
    rng, parts = np.random.default_rng(seed), []
    a, b = list(rig.cameras.values())[:2]
    for frame in range(FRAMES):
        points = points_in_front(rng, 3 * count)
        normals = (
            rng.normal(0, 0.4, points.shape) + points / np.linalg.norm(points, axis=1)[:, None]
        )
        planes = normals / (normals * points).sum(axis=1, keepdims=True)
        pixels, seen = [], np.ones(len(points), np.bool_)
        for camera in (a, b):
            T = camera.T_camera_lidar
            projected, valid = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
            pixels.append(projected + noise_px * rng.standard_normal(projected.shape))
            seen &= valid & camera.in_image(projected)
        rows = np.flatnonzero(seen)[:count]
        both = np.stack(pixels, axis=1)[rows]
        wrong = rng.random(len(rows)) < outliers
        both[wrong, 1, 0] += rng.uniform(-80, 80, np.count_nonzero(wrong))  # along epipolar lines
        sides = np.repeat(planes[rows, None], 2, axis=1)
        sides[rng.random(len(rows)) < 0.3] = np.nan
        parts.append((np.full(len(rows), frame), both, sides))
    columns = [np.concatenate([part[k] for part in parts]) for k in range(3)]
    index = np.tile(np.array([0, 1], np.int32), (len(columns[0]), 1))
    return CameraMatches(tuple(rig.cameras), index, *columns)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return calibgraph.load_rig(calibgraph.__path__[0] + "/../data/sample/reference.yaml")


def solve_pair(rig: Rig, terms: tuple[PairTerm, ...], held: float) -> dict[str, np.ndarray]:
    """Minimize the terms of a pair alone, with the first camera held to its guess."""
    names = list(rig.cameras)[:2]
    keys = {name: pose_key(names, name) for name in names}
    T = {name: rig.T_camera_lidar[name] for name in names}
    hold = gtsam.noiseModel.Diagonal.Sigmas(pose_sigmas(rotation_rad=held, translation_m=10 * held))
    for _ in range(6):
        graph = pair_graph([term.with_sigma(term.sigma_px(T)) for term in terms], keys)
        start = to_T_lidar_camera(rig.T_camera_lidar[names[0]])
        graph.add(gtsam.PriorFactorPose3(keys[names[0]], start, hold))
        T = optimize(graph, names, T).T_camera_lidar
    return T


def pair_error(T: dict[str, np.ndarray], truth: Rig) -> tuple[float, float]:
    """Of the relative pose of the first two cameras: deg, cm."""
    a, b = list(truth.cameras)[:2]
    both = [relative_transform(each[b], each[a]) for each in (T, truth.T_camera_lidar)]
    return pose_difference(*both)


@pytest.mark.parametrize("rig_name", ["pair", "mixed_rig"])
def test_the_relative_pose_is_found_without_noise(
    rig_name: str, request: pytest.FixtureRequest
) -> None:
    truth: Rig = request.getfixturevalue(rig_name)
    table = simulated_pairs(truth, noise_px=0.0, outliers=0.0)
    a, b = list(truth.cameras)[:2]
    moved = perturb(truth, rotation_deg=1.0, translation_m=0.1, seed=1)
    guess = truth.moved_to({b: moved.T_camera_lidar[b]})
    terms = pair_terms(guess, table)
    assert {(term.a, term.b) for term in terms} == {(a, b), (b, a)}
    degrees, centimetres = pair_error(solve_pair(guess, terms, 1e-7), truth)
    assert degrees < 1e-5 and centimetres < 1e-4


def test_a_wrong_pose_of_a_does_not_spoil_the_relative_pose(pair: Rig) -> None:
    """A is 1.5 deg and 30 cm off, and only loosely held there."""
    table = simulated_pairs(pair)
    guess = perturb(pair, rotation_deg=1.5, translation_m=0.3, seed=3)
    terms = pair_terms(guess, table)
    degrees, centimetres = pair_error(solve_pair(guess, terms, 0.03), pair)
    assert degrees < 0.02 and centimetres < 0.5


def test_features_without_a_surface_give_the_direction(pair: Rig) -> None:
    """Epipolar residuals determine all but the length of the baseline."""
    table = simulated_pairs(pair)
    bare = replace(table, planes_lidar_per_m=np.full_like(table.planes_lidar_per_m, np.nan))
    terms = pair_terms(pair, bare)
    assert [term.block.axes for term in terms] == [1]
    guess = pair.moved_to({"right": perturb(pair, rotation_deg=0.5, translation_m=0.05, seed=2)
                           .T_camera_lidar["right"]})  # fmt: skip
    T = solve_pair(guess, terms, 1e-7)
    found, true = (relative_transform(each["right"], each["left"]) for each in
                   (T, pair.T_camera_lidar))  # fmt: skip
    assert pose_difference(found, true)[0] < 0.05
    directions = [each[:3, 3] / np.linalg.norm(each[:3, 3]) for each in (found, true)]
    assert directions[0] @ directions[1] > np.cos(np.radians(0.3))


def test_pairs_with_too_few_matches_have_no_term(pair: Rig) -> None:
    table = simulated_pairs(pair)
    assert pair_terms(pair, table.select(slice(0, MIN_PAIR_MATCHES - 1))) == ()
    assert pair_terms(pair, CameraMatches.empty(tuple(pair.cameras))) == ()


def test_sigma_and_gate_fit_the_noise(pair: Rig) -> None:
    """0.3 px in each image; a tenth of outliers, most of them beyond the gate."""
    table = simulated_pairs(pair, outliers=0.1)
    term = pair_terms(pair, table)[0]
    sigma = term.sigma_px(pair.T_camera_lidar)
    # Both images' noise adds up; the disparity's also by way of the point on an oblique plane.
    assert 0.3 * np.sqrt(2) * 0.8 < sigma < 0.3 * np.sqrt(2) * 1.3
    kept = term.without_outliers(pair.T_camera_lidar, sigma)
    assert 0.8 < len(kept.frame) / len(term.frame) < 0.95
    assert np.median(kept.errors_px(pair.T_camera_lidar)) < 2 * sigma


def solved(rig: Rig, with_pairs: bool, seed: int = 0) -> Solution:
    """The joint solve of matches whose errors a camera's frame shares, and of camera pairs."""
    errors = MatcherErrors(field_px=1.0, outlier_share=0.1)
    table = simulate_correspondences(rig, frames=FRAMES, errors=errors, seed=seed)
    start = perturb(rig, rotation_deg=1, translation_m=0.1, seed=seed)
    matches = simulated_pairs(rig, seed=seed) if with_pairs else None
    return solve_joint(start, table, camera_matches=matches)


def test_pairs_make_the_relative_pose_better_in_the_joint_solve(rig: Rig) -> None:
    errors = np.array(
        [
            [pair_error(solved(rig, w, s).T_camera_lidar, rig) for w in (False, True)]
            for s in range(3)
        ]
    )
    without, joint = np.median(errors, axis=0)
    # These features err by themselves; the solve expects 0.4 cm of all of a pair.
    assert joint[0] < 0.5 * without[0] and joint[1] < 0.75 * without[1]


def test_the_joint_optimum_of_a_paper_preset_is_that_of_all_terms(rig: Rig) -> None:
    """The objective of the solution has the pairs' factors, and no gradient at the solution."""
    errors = MatcherErrors(field_px=1.0, outlier_share=0.1)
    table = simulate_correspondences(rig, frames=FRAMES, errors=errors, seed=0)
    config = Config(preset="kitti")
    solution = solve_joint(rig, table, config, camera_matches=simulated_pairs(rig))
    objective = solution.inliers
    bare = replace(objective, pairs=())
    graph = objective.graph(solution.scales)
    assert graph.size() == bare.graph(solution.scales).size() + len(objective.pairs)
    assert objective.pose_graph.size() == bare.pose_graph.size()
    again = objective.minimize(solution.T_camera_lidar, solution.scales)
    assert again.cost == pytest.approx(solution.optimum.cost, rel=1e-9)
    moved = perturb(
        rig.moved_to(solution.T_camera_lidar), rotation_deg=0.3, translation_m=0.03, seed=9
    )
    back = objective.minimize(moved.T_camera_lidar, solution.scales)
    assert pair_error(back.T_camera_lidar, rig.moved_to(solution.T_camera_lidar))[1] < 0.05


def test_without_pairs_nothing_is_left_of_them(rig: Rig) -> None:
    alone, found = solved(rig, False), solved(rig, True).without_pairs()
    np.testing.assert_allclose(found.covariance, alone.covariance, rtol=1e-9)


def test_a_calibration_takes_them_and_its_pair_is_better_known(rig: Rig) -> None:
    errors = MatcherErrors(field_px=1.0, outlier_share=0.1)
    table = simulate_correspondences(rig, frames=FRAMES, errors=errors, seed=0)
    shared = {"systematic_rotation_rad": 0.002, "systematic_translation_m": 0.02}
    table = replace(table, metadata={**table.metadata, **shared})
    known = with_known_lenses(rig)
    results = [
        calibgraph.solve(known, table, camera_matches=matches)
        for matches in (None, simulated_pairs(rig))
    ]
    a, b = list(rig.cameras)[:2]
    sigmas = []
    for result in results:
        T_b_a = relative_transform(result.T_camera_lidar[b], result.T_camera_lidar[a])
        covariance = relative_covariance(result.joint_covariance, 0, 1, T_b_a)
        sigmas.append(np.sqrt(np.diag(covariance)))
    assert "camera_pairs" in results[1].timings_s and "camera_pairs" not in results[0].timings_s
    assert (sigmas[1] < 0.5 * sigmas[0]).all()
    twist = twist_between(
        *(relative_transform(T[b], T[a]) for T in (results[1].T_camera_lidar, rig.T_camera_lidar))
    )
    assert (np.abs(twist) < 4 * sigmas[1]).all()


def test_a_camera_without_correspondences_is_placed_by_what_it_sees_in_common(pair: Rig) -> None:
    """Its guess is 2 deg and 20 cm off, the other's correspondences are good."""
    table = simulate_correspondences(pair, frames=FRAMES)
    left = table.select(table.camera_index == table.cameras.index("left"))
    guess = perturb(pair, rotation_deg=2, translation_m=0.2, seed=5)
    with pytest.raises(CorrespondenceError, match="'right' has 0 usable correspondences"):
        solve_joint(guess, left)
    few = simulated_pairs(pair).select(slice(0, 20))
    with pytest.raises(CorrespondenceError, match="'right' has 0 usable correspondences"):
        solve_joint(guess, left, camera_matches=few)
    result = calibgraph.solve(guess, left, camera_matches=simulated_pairs(pair))
    degrees, centimetres = pair_error(result.T_camera_lidar, pair)
    assert degrees < 0.05 and centimetres < 1
    sigmas = result.sigmas("right")
    assert sigmas is not None and sigmas[0].max() < 0.2
    (check,) = [c for c in result.camera_verdicts["right"].checks if c.name == "correspondences"]
    assert check.status == "WARN" and "see in common" in check.text
    with pytest.raises(CorrespondenceError, match="'right' has 0 usable correspondences"):
        solve_joint(guess, left, terms="priors", camera_matches=simulated_pairs(pair))
