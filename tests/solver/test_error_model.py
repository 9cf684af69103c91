"""What errors are made of: what is stated, what is learnt, and the shares of an error bar."""

from dataclasses import replace
from typing import Any

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
from calibgraph.model.config import Config, preset
from calibgraph.model.error_sources import COMMON, MATCHES, MOST_TIMES
from calibgraph.model.findings import MatcherFindings, error_components
from calibgraph.model.verdict import COMMON_ERROR
from calibgraph.simulation.correspondences import PoseSpread
from calibgraph.solver.error_model import fit_errors
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.places import ErrorFit
from calibgraph.trust.evidence import Evidence
from tests.draws.lenses import with_known_lenses
from tests.draws.places import displaced
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
