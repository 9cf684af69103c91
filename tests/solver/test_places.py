"""The error model: its estimate is the optimum and the marginal of the whole graph."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibgraph import Config, Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.graph.components import EXACT
from calibgraph.graph.latent_poses import LatentPoseModel, latent_pose_graph
from calibgraph.graph.variables import (
    DISTORTION,
    aligned_key,
    camera_key,
    matched_at_key,
    matched_key,
    paired_key,
)
from calibgraph.solver.error_model import fit_errors
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.pairs import pair_terms
from calibgraph.solver.places import ErrorFit, fit_latent_poses, start_values
from tests.conftest import stereo_relative_pose
from tests.solver.latent import all_values, linearized, reported_keys
from tests.solver.test_camera_pairs import simulated_pairs

ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
STATED = {
    "systematic_rotation_rad": 1.5e-3,
    "systematic_translation_m": 0.02,
    "elevation_rad": 1e-3,
    "elevation_stretch": 0.005,
    "scan_motion_m": 0.1,
    "place_rotation_rad": 7e-4,
    "place_translation_m": 0.006,
    "place_variance": 8.0,
}
PLACES = {"one": [], "four": [[0, 1], [2, 3], [4, 5]]}
CASES = [
    ("pair", False, False, False, "one", 8),
    ("pair", True, False, False, "four", 8),
    ("pair", False, True, True, "four", 8),
    ("pair", True, True, False, "one", 8),
    ("pair", False, True, False, "one", 1),
    ("mixed_rig", True, True, False, "four", 8),
    ("mixed_rig", False, True, True, "four", 8),
]


def require_optimum(
    found: ErrorFit,
    graph: gtsam.NonlinearFactorGraph,
    optimum: tuple[gtsam.Values, gtsam.Marginals],
) -> None:
    """Check poses, covariances and cost against the optimum of the graph."""
    values, marginals = optimum
    for reported in (found, found.of_mount):
        keys = reported_keys(reported)
        for key, T in zip(keys, reported.T_camera_lidar.values(), strict=True):
            expected = values.atPose3(key).inverse().matrix()
            np.testing.assert_allclose(T, expected, rtol=0, atol=1e-8)
        covariance = marginals.jointMarginalCovariance(keys).fullMatrix()
        if keys != found.model.camera_keys:  # they are tied, nearly exactly
            covariance = covariance - EXACT**2 * np.eye(len(covariance))
        unit = np.sqrt(np.outer(np.diag(covariance), np.diag(covariance)))
        matches = reported.covariance - reported.by_lenses
        np.testing.assert_allclose(matches / unit, covariance / unit, rtol=0, atol=1e-6)
    assert found.cost == pytest.approx(2 * graph.error(values), rel=1e-9)
    distortion, spread = found.distortion
    np.testing.assert_allclose(distortion, values.atVector(DISTORTION), rtol=0, atol=1e-5)
    np.testing.assert_allclose(spread, marginals.marginalCovariance(DISTORTION), rtol=1e-5)


@pytest.mark.parametrize(("rig_name", "pairs", "tied", "silent", "places", "frames"), CASES)
def test_the_estimate_is_the_optimum_and_the_marginal_of_the_graph_that_is_printed(
    rig_name: str, pairs: bool, tied: bool, silent: bool, places: str, frames: int,
    request: pytest.FixtureRequest,
) -> None:  # fmt: skip
    """Also from far; silent: the first camera has no matches."""
    rig: Rig = request.getfixturevalue(rig_name)
    rig = tie(rig) if tied else rig
    errors = solve_model(rig, table_of(rig, frames, silent, PLACES[places]), pairs=pairs)
    model = with_correlations(errors.model)
    start, graph = all_values(start_values(model, errors.T_camera_lidar)), latent_pose_graph(model)
    values = minimize(graph, displaced(model, start, 0.01))
    marginals = gtsam.Marginals(graph, values)
    for degrees in (0.01, 5.0):
        found = fit_latent_poses(
            model, linearized(model, displaced(model, start, degrees)), relative_tolerance=0.0
        )
        assert found is not None and found.converged
        require_optimum(found, graph, (values, marginals))


def displaced(model: LatentPoseModel, values: gtsam.Values, degrees: float) -> gtsam.Values:
    """Every camera turned and moved, with all poses in which its data show it."""
    rng, found = np.random.default_rng(2), gtsam.Values(values)
    for number in range(len(model.cameras)):
        step = np.radians(degrees) * rng.standard_normal(6)
        keys = [of(number) for of in (camera_key, aligned_key, matched_key, paired_key)]
        keys += [matched_at_key(place, number) for place in range(model.places)]
        for key in keys:
            if values.exists(key):
                found.update(key, values.atPose3(key).retract(step))
    return found


def minimize(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Values:
    """By GTSAM's Levenberg-Marquardt."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(0.0)
    parameters.setMaxIterations(100)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def tie(rig: Rig) -> Rig:
    """The first two cameras, 0.1 deg and 1 cm off."""
    exact = stereo_relative_pose(rig, *list(rig.cameras)[:2], sigmas=(1e-3, 0.005))
    off = gtsam.Pose3.Expmap(np.repeat([1e-3, 0.006], 3)).matrix()
    measured = exact.model_copy(update={"T_a_b": exact.T_a_b @ off})
    return rig.model_copy(update={"relative_poses": (measured,)})


def table_of(
    rig: Rig, frames: int, silent: bool, places: Sequence[Sequence[int]]
) -> Correspondences:
    table = simulate_correspondences(rig, frames=frames, matches=80, errors=ERRORS, seed=0)
    if silent:
        table = table.select(table.camera_index != table.cameras.index(next(iter(rig.cameras))))
    return replace(table, metadata={**table.metadata, **STATED, "places": list(places)})


def solve_model(rig: Rig, table: Correspondences, *, pairs: bool) -> ErrorFit:
    matches = simulated_pairs(rig, count=40) if pairs else None
    solution = solve_joint(rig, table, Config(learnt_weights=False), camera_matches=matches)
    errors = solution.errors or fit_errors(solution.fitted, table.findings, table.places)
    return errors


def with_correlations(model: LatentPoseModel) -> LatentPoseModel:
    """The same, with covariances that are neither diagonal nor equal."""
    rng = np.random.default_rng(1)

    def mixed(covariance: np.ndarray) -> np.ndarray:
        mix = np.eye(6) + 0.2 * rng.standard_normal((6, 6))
        scale = np.sqrt(np.diag(covariance))
        return (scale[:, None] * mix) @ (scale[:, None] * mix).T

    parts = model.components
    jacobian, pair_jacobian = (
        each + 1e-3 * rng.standard_normal(each.shape)
        for each in (parts.distortion_jacobian, parts.pair_distortion_jacobian)
    )
    components = replace(
        parts,
        cloud=mixed(parts.cloud),
        cloud_at_place=mixed(parts.cloud_at_place),
        camera=mixed(parts.camera),
        pairs=mixed(parts.pairs),
        at_place=np.array([[mixed(one) for one in place] for place in parts.at_place]),
        distortion_jacobian=jacobian,
        pair_distortion_jacobian=pair_jacobian,
        distortion_information=parts.distortion_information + np.diag([0.5, 1.0, 2.0]),
        distortion_vector=parts.distortion_vector + np.array([0.4, -0.3, 0.8]),
        distortion_size=1.5,
    )
    return replace(model, components=components)


def test_a_pair_of_which_the_gate_has_left_nothing_takes_no_part(pair: Rig) -> None:
    table, matches = table_of(pair, 6, False, []), simulated_pairs(pair, count=40)
    solution = solve_joint(pair, table, Config(learnt_weights=False), camera_matches=matches)
    term = pair_terms(pair, matches)[0].with_sigma(1.0)
    empty = term.select(np.zeros(len(term.frame), np.bool_))
    more = replace(solution.inliers, pairs=(*solution.inliers.pairs, empty))
    found, expected = (
        fit_errors(replace(solution.fitted, objective=inliers), table.findings, table.places)
        for inliers in (more, solution.inliers)
    )
    np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_matches_of_one_place_decide_by_themselves(pair: Rig) -> None:
    """Nothing contradicts them: the solve has no model, and the model the same minimum."""
    table = table_of(pair, 8, False, [])
    bends = ("elevation_rad", "elevation_stretch", "scan_motion_m")
    table = replace(table, metadata={k: v for k, v in table.metadata.items() if k not in bends})
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    solution = solve_joint(pair, table, config)
    assert solution.errors is None
    errors = fit_errors(solution.fitted, table.findings, table.places)
    for name, T in errors.T_camera_lidar.items():
        np.testing.assert_allclose(T, solution.T_camera_lidar[name], rtol=0, atol=1e-7)


def test_data_that_determine_far_less_than_exact_ties_have_an_error_bar(pair: Rig) -> None:
    """Nine of ten matches are wrong; cloud and camera are stated to be exact."""
    table = simulate_correspondences(pair, errors=MatcherErrors(outlier_share=0.9), seed=0)
    assert table.metadata["systematic_translation_m"] == 0.0
    solution = solve_joint(pair, table, Config(learnt_weights=False))
    errors = fit_errors(solution.fitted, table.findings, table.places)
    assert errors is not None and errors.converged
    assert np.isfinite(errors.covariance).all()
