"""What errors are made of: what is stated, what is learnt, and the shares of an error bar."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Correspondences,
    MatcherErrors,
    Rig,
    concatenate,
    simulate_correspondences,
    solve,
)
from calibgraph.graph.components import VarianceRatios
from calibgraph.graph.latent_poses import data_graph, latent_pose_graph, to_ordering
from calibgraph.graph.variables import DISTORTION
from calibgraph.model.config import Config, preset
from calibgraph.model.error_sources import COMMON, MATCHES, MOST_TIMES
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.model.verdict import COMMON_ERROR
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.error_model import fit_errors
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.matches import camera_blocks
from calibgraph.solver.pair_refinement import (
    PairFit,
    fit_pairs,
    place_pairs,
    shared_variance_ratio,
)
from calibgraph.solver.pairs import pair_terms
from calibgraph.solver.places import ErrorFit
from calibgraph.solver.robust import ResidualScale
from calibgraph.solver.sources import variances_by_source
from calibgraph.solver.within_place import block_by_place
from calibgraph.trust.evidence import Evidence
from factors import pose_sigmas
from tests.draws.lenses import with_known_lenses
from tests.draws.places import displaced
from tests.solver.latent import all_values, place_keys, reported_keys
from tests.solver.test_camera_pairs import simulated_pairs

ZERO = {"systematic_rotation_rad": 0.0, "systematic_translation_m": 0.0}


def stating(rig: Rig, metadata: dict[str, Any]) -> Correspondences:
    return replace(simulate_correspondences(rig, frames=8, matches=200), metadata=metadata)


def common_checks(rig: Rig, found: Correspondences, config: Config | None = None) -> list[str]:
    result = solve(rig, found, config)
    return [c.text for c in result.camera_verdicts["left"].checks if c.kind == COMMON_ERROR]


@pytest.mark.parametrize("metadata", [{}, {"matcher": "mine"}, {"name": "picked by hand"}])
def test_a_table_that_states_none_is_no_pass(pair: Rig, metadata: dict[str, Any]) -> None:
    result = solve(pair, stating(pair, metadata))
    assert result.verdict.status == "WARN" and result.verdict.cannot_tell
    (reason,) = result.summary.reasons
    assert reason.text.startswith("cannot tell: scatter only: ")
    assert reason.cameras == ("left", "right")
    assert any("common_deg and common_cm" in action for action in result.summary.actions)


@pytest.mark.parametrize("matcher", ["structure", "cmrnext"])
def test_a_known_matcher_has_its_usual_one(pair: Rig, matcher: str) -> None:
    usual = MatcherFindings(**error_components().matchers[matcher])
    found = MatcherFindings.from_metadata({"matcher": matcher})
    assert found.systematic_rotation_rad == usual.systematic_rotation_rad
    assert found.place_variance == usual.place_variance
    assert not common_checks(pair, stating(pair, {"matcher": matcher}))
    silent, known = (
        solve(with_known_lenses(pair), stating(pair, metadata)).sigmas("left")
        for metadata in ({}, {"matcher": matcher})
    )
    assert known[0].max() > 3 * silent[0].max() and known[1].max() > 3 * silent[1].max()
    own = MatcherFindings.from_metadata({"matcher": matcher, **ZERO})
    assert own.systematic_sigmas == (0.0, 0.0) and own.place_variance == 0.0


def test_the_settings_state_it_for_a_table_that_does_not(pair: Rig) -> None:
    config = Config(common_deg=0.1, common_cm=2.0)
    sigmas = solve(pair, stating(pair, {}), config).sigmas("left")
    assert sigmas is not None and sigmas[0].max() > 0.1 and sigmas[1].max() > 2.0
    assert not common_checks(pair, stating(pair, {}), config)
    assert not common_checks(pair, stating(pair, {}), Config(common_deg=0.0))


def test_simulated_matchers_state_it_where_they_have_none(pair: Rig) -> None:
    biased = MatcherErrors(bias_pose=PoseSpread(rotation_deg=(0.1, 0.1, 0.1)))
    for errors, states in ((MatcherErrors(), True), (biased, False)):
        found = simulate_correspondences(pair, frames=1, matches=50, errors=errors)
        assert found.findings.states_common_error == states
        kept = MatcherFindings.from_metadata(found.findings.to_metadata())
        assert kept.states_common_error == states


def test_few_frames_add_what_is_usual_and_many_keep_their_own_scatter() -> None:
    """The gradient of one frame is zero at the solution; of ten, pseudo frames add a diagonal."""
    rng, hessian = np.random.default_rng(0), np.diag([4.0, 3.0, 2.0, 1.0])
    usual = np.diag([9.0, 8.0, 7.0, 6.0])
    found = with_pseudo_frames(np.zeros((4, 4)), hessian, 1.0, usual)
    np.testing.assert_allclose(found, usual)
    few, many = (rng.standard_normal((frames, 4)) for frames in (10, 4000))
    scatter = few.T @ few
    found = with_pseudo_frames(scatter, hessian, 10.0)
    np.testing.assert_allclose(found, scatter + 6 / 9 * np.diag(np.diag(scatter)))
    scatter = many.T @ many
    found = with_pseudo_frames(scatter, hessian, 4000.0, 100 * scatter)
    np.testing.assert_allclose(found, scatter, rtol=0.02, atol=0.02 * scatter[0, 0])


SHARED_RAD, SHARED_M = np.radians(0.09), 0.02
STATED: dict[str, Any] = {
    "systematic_rotation_rad": float(SHARED_RAD),
    "systematic_translation_m": SHARED_M,
    "camera_share": 0.4,
}
OF_A_SENSOR = STATED | {
    "systematic_rotation_rad": float(np.radians(0.15)),
    "elevation_rad": float(np.radians(0.12)),
    "place_variance": 6.0,
    "place_rotation_rad": 3e-4,
    "place_translation_m": 0.006,
}
A_PLACE = 3  # frames


def table_of_places(rig: Rig, places: int, stated: dict[str, Any]) -> Correspondences:
    """Matches of a pixel of noise, of several places."""
    frames = A_PLACE * places
    found = simulate_correspondences(rig, frames=frames, errors=MatcherErrors(), seed=3)
    lists = np.arange(frames).reshape(places, -1).tolist()
    return replace(found, metadata={**stated, "places": lists})


def evidence(rig: Rig, found: Correspondences, config: Config | None = None) -> Evidence:
    return Evidence(solve_joint(rig, found, config or Config()), rig)


@pytest.mark.parametrize("config", [Config(), preset("kitti")])
def test_what_all_frames_share_is_the_share_that_its_size_has(pair: Rig, config: Config) -> None:
    found = evidence(pair, table_of_places(pair, 2, STATED), config).error_sources["left"]
    assert sum(found.rotation.values()) == pytest.approx(1.0)
    # The cloud turns about the LiDAR, as far as the camera.
    expected = (np.degrees(SHARED_RAD) / found.rotation_deg) ** 2
    assert found.rotation[COMMON] == pytest.approx(expected, rel=0.01)
    assert found.rotation[COMMON] > 0.5 > found.rotation[MATCHES] > 0


def test_the_shares_are_those_of_independent_errors_and_add_up(pair: Rig) -> None:
    """The part that is left to the matches is the one that their own equations give."""
    errors = evidence(pair, table_of_places(pair, 3, OF_A_SENSOR)).solution.error_fit
    parts = variances_by_source(errors)
    whole = np.diag(errors.covariance)  # of which the matches are 3e-4 to 7e-3
    np.testing.assert_allclose((sum(parts.values()) + of_matches(errors)) / whole, 1, atol=1e-8)


def of_matches(errors: ErrorFit) -> np.ndarray:
    """(6 N,) variances by the data, by the residuals of the distortion, and by the scatter.

    From the dense covariance C: C G C, with G the information of each of these.
    """
    linear = errors.linear
    weight, values, parts = linear.ties.weight.T, all_values(linear), errors.model.components
    cameras = weight[:, 1:, None, None]
    parts = replace(
        parts,
        cloud_at_place=parts.cloud_at_place / weight[:, 0, None, None],
        at_place=parts.at_place / cameras,
        scatter_at_place=parts.scatter_at_place / cameras,
        robust_scale=np.inf,
    )
    model = replace(errors.model, components=parts)
    reported = reported_keys(errors)
    order = to_ordering([*reported, *model.columns, *place_keys(model)])
    starts, end = {}, 0
    for number in range(order.size()):
        starts[order.at(number)] = end
        end += 3 if order.at(number) == DISTORTION else 6
    graph, data = (of(model).linearize(values) for of in (latent_pose_graph, data_graph))
    moved = np.linalg.inv(graph.hessian(order)[0])[: 6 * len(model.cameras)]
    information = np.zeros((end, end))
    for number in range(data.size()):
        factor = data.at(number)
        rows = np.concatenate([starts[key] + np.arange(6) for key in list(factor.keys())])
        information[np.ix_(rows, rows)] += factor.information()
    rows = starts[DISTORTION] + np.arange(3)
    information[np.ix_(rows, rows)] += parts.distortion_information
    for number, (place, camera) in enumerate(model.matched_places):
        edge = model.place_graph.at(model.places + number)
        root = edge.noiseModel().R()
        whitened, _ = edge.linearize(values).jacobian()
        rows = np.concatenate([starts[key] + np.arange(6) for key in list(edge.keys())])
        scatter = root @ parts.scatter_at_place[place, camera] @ root.T
        information[np.ix_(rows, rows)] += whitened.T @ scatter @ whitened
    return np.diag(moved @ information @ moved.T)


def test_the_error_bar_of_more_frames_is_as_predicted(pair: Rig) -> None:
    few = evidence(pair, table_of_places(pair, 5, OF_A_SENSOR)).error_sources
    many = evidence(pair, table_of_places(pair, 25, OF_A_SENSOR)).error_sources
    for name, before in few.items():
        after = many[name].rotation_deg, many[name].translation_cm
        assert before.rotation_deg > after[0] and before.translation_cm > after[1]
        # Scatter of 15 frames, so of 12 degrees of freedom: sigmas to 20 %, of a part.
        assert before.forecast[5] == pytest.approx(after, rel=0.2)


def test_recording_is_advised_only_where_it_shrinks_the_error_bar_enough(pair: Rig) -> None:
    found = evidence(pair, table_of_places(pair, 2, OF_A_SENSOR)).error_sources["left"]
    assert found.describe((0.5, 100.0)).startswith(f"{found.rotation_deg:.2g} deg (1 sigma)")
    best_deg = found.forecast[MOST_TIMES][0]
    wide = found.rotation_deg / 0.3
    assert found.action((1.01 * wide, 100.0)) == ""
    twice = 1.001 * found.forecast[2][0] / 0.3
    assert found.action((twice, 100.0)).startswith("Record 2 times as many frames")
    limited = found.action((0.9 * best_deg / 0.3, 100.0))
    assert "Record" not in limited and limited.startswith("Tolerate more")
    assert f"{best_deg:.2g} deg" in limited


EACH = pose_sigmas(rotation_rad=2e-3, translation_m=0.03) ** 2


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
    terms = pair_terms(rig, simulated_pairs(rig))
    T = rig.T_camera_lidar
    return fit_pairs(terms, T, held, place_pairs(terms, T))


def test_it_is_never_taken_for_less_than_usual_and_as_usual_without_tied_cameras(pair: Rig) -> None:
    covariance = np.diag(np.tile(EACH, 2))
    for fits in (fits_of(pair), ()):
        assert shared_variance_ratio(pair.T_camera_lidar, covariance, fits) == 1.0


def test_a_displaced_camera_widens_the_error_bars(pair: Rig) -> None:
    """The matches of one camera are displaced by 12 cm, which images of both show."""
    table = simulate_correspondences(
        pair, frames=6, errors=MatcherErrors(outlier_share=0.1), seed=0
    )
    metadata = {"systematic_rotation_rad": 1e-3, "systematic_translation_m": 0.01}
    moved = table.points_lidar_m.copy()
    moved[table.camera_index == table.cameras.index("right")] += [0.0, 0.12, 0.0]
    widths = []
    for points in (table.points_lidar_m, moved):
        given = replace(table, points_lidar_m=points, metadata=metadata)
        solution = solve_joint(pair, given, camera_matches=simulated_pairs(pair))
        evidence = Evidence(solution, pair)
        covariance = evidence.covariance_of("right")
        widths.append(float(np.sqrt(covariance[3, 3])))
        errors = [
            np.linalg.norm(solution.T_camera_lidar[n][:3, 3] - pair.T_camera_lidar[n][:3, 3])
            for n in pair.cameras
        ]
    assert max(errors) > 0.02
    assert widths[1] > 2 * widths[0]


EXACT = MatcherErrors(noise_px=0.3, outlier_share=0.0)
OF_PLACES = {"place_rotation_rad": 1e-3, "place_translation_m": 0.01, "camera_share": 0.0}
SIGMAS = np.repeat([1e-3, 0.01], 3)


def table_of(rig: Rig, places: int, size: float, seed: int) -> Correspondences:
    """The cloud is displaced at each place, by ``size`` times the variance that is stated."""
    rng, tables = np.random.default_rng(seed), []
    for place in range(places):
        cloud = np.sqrt(size) * SIGMAS * rng.standard_normal(6)
        there = displaced(rig, cloud, np.zeros((len(rig.cameras), 6)))
        table = simulate_correspondences(
            there, frames=2, matches=200, errors=EXACT, seed=int(rng.integers(2**31))
        )
        tables.append(replace(table, frame=table.frame + 2 * place))
    joined = concatenate(tables)
    names = [[2 * place, 2 * place + 1] for place in range(places)]
    return replace(joined, metadata={**joined.metadata, **OF_PLACES, "places": names})


def errors_of(rig: Rig, table: Correspondences) -> ErrorFit:
    solution = solve_joint(rig, table, Config(learnt_weights=False))
    found = solution.errors or fit_errors(solution.fitted, table.findings, table.places)
    return found


@pytest.mark.parametrize("size", [0.25, 2.0])
def test_the_size_of_places_is_found_from_many_of_them(pair: Rig, size: float) -> None:
    places = 20
    found = [errors_of(pair, table_of(pair, places, size, seed)).ratios.cloud for seed in range(4)]
    # 6 (places - 1) degrees of freedom a table; what is usual counts as 12 of size 1.
    free = 6 * (places - 1)
    expected = (12 + free * size) / (12 + free)
    spread = size * np.sqrt(2 / free / len(found))
    assert np.mean(found) == pytest.approx(expected, rel=0.15, abs=4 * spread)


def test_few_places_are_never_taken_for_better_than_usual_and_one_says_nothing(pair: Rig) -> None:
    """At one place nothing is measured twice, so nothing is learnt, whatever the error."""
    for places, size in ((4, 0.0), (1, 25.0)):
        assert errors_of(pair, table_of(pair, places, size, 0)).ratios == VarianceRatios()


def test_a_larger_variance_and_a_smaller_weight_divide_the_sums(pair: Rig) -> None:
    """Of matches with information of their own; the loss bends at the same pixels."""
    table = simulate_correspondences(pair, frames=2, matches=50, errors=MatcherErrors(noise_px=1.0))
    stretched = np.tile([0.5, 0.1, 2.0], (len(table), 1))
    table = replace(table, information_px=stretched)
    blocks = camera_blocks(pair, table, Config())
    for name, T in pair.T_camera_lidar.items():
        block, pose = blocks[name], to_T_lidar_camera(T)
        scale = ResidualScale(1.0, 3.0, 9.0, 1.0)
        placed = block_by_place(block, scale, [np.arange(2)])
        one, two = (
            each.sums(T[None])
            for each in (placed, replace(placed, block=placed.block.with_variance(4.0)))
        )
        for part in ("hessian", "gradient", "cost"):
            np.testing.assert_allclose(getattr(two, part), getattr(one, part) / 4, rtol=1e-12)
        quadratic = replace(scale, loss_scale=1e6)
        all_of_it, light = (
            each.with_scale(quadratic).sums(pose).hessian
            for each in (block, block.with_weights(np.full(len(block), 0.25)))
        )
        np.testing.assert_allclose(light, all_of_it / 4, rtol=1e-6)
