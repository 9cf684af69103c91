"""The shares of an error bar's sources, and the error bar that more frames would have."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calibgraph import Correspondences, MatcherErrors, Rig, simulate_correspondences
from calibgraph.graph.latent_poses import to_ordering
from calibgraph.graph.variables import DISTORTION
from calibgraph.model.config import Config, preset
from calibgraph.model.error_sources import COMMON, MATCHES, MOST_TIMES
from calibgraph.solver.elimination import join_linear
from calibgraph.solver.error_model import ErrorFit
from calibgraph.solver.error_shares import variances_by_source
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.evidence import Evidence

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


def table(rig: Rig, places: int, stated: dict[str, Any]) -> Correspondences:
    """Matches of a pixel of noise, of several places."""
    frames = A_PLACE * places
    found = simulate_correspondences(rig, frames=frames, errors=MatcherErrors(), seed=3)
    lists = np.arange(frames).reshape(places, -1).tolist()
    return replace(found, metadata={**stated, "places": lists})


def evidence(rig: Rig, found: Correspondences, config: Config | None = None) -> Evidence:
    return Evidence(solve_joint(rig, found, config or Config()), rig)


@pytest.mark.parametrize("config", [Config(), preset("kitti")])
def test_what_all_frames_share_is_the_share_that_its_size_has(pair: Rig, config: Config) -> None:
    found = evidence(pair, table(pair, 2, STATED), config).error_sources["left"]
    assert sum(found.rotation.values()) == pytest.approx(1.0)
    # The cloud turns about the LiDAR, as far as the camera.
    expected = (np.degrees(SHARED_RAD) / found.rotation_deg) ** 2
    assert found.rotation[COMMON] == pytest.approx(expected, rel=0.01)
    assert found.rotation[COMMON] > 0.5 > found.rotation[MATCHES] > 0


def test_the_shares_are_those_of_independent_errors_and_add_up(pair: Rig) -> None:
    """The part that is left to the matches is the one that their own equations give."""
    errors = evidence(pair, table(pair, 3, OF_A_SENSOR)).solution.marginals.errors
    assert errors is not None
    parts = variances_by_source(errors)
    matches = np.diag(errors.fit.covariance) - sum(parts.values())
    assert matches == pytest.approx(of_matches(errors), rel=1e-6)


def of_matches(errors: ErrorFit) -> np.ndarray:
    """(6 N,) variances by the data, by the residuals of the distortion, and by the scatter.

    From the dense covariance C: C G C, with G the information of each of these.
    """
    linear, weight = (
        errors.fit.linear,
        errors.fit.place_weights(errors.model.components.robust_scale),
    )
    parts = errors.model.components.with_fixed_weights(weight)
    model = replace(errors.model, components=parts)
    order = to_ordering([*model.reported_keys, *model.shared_keys[: -len(model.cameras)],
                         *model.place_keys])  # fmt: skip
    starts, end = {}, 0
    for number in range(order.size()):
        starts[order.at(number)] = end
        end += 3 if order.at(number) == DISTORTION else 6
    graph = join_linear(linear.shared, linear.placed)
    moved = np.linalg.inv(graph.hessian(order)[0])[: 6 * len(model.cameras)]
    information = np.zeros((end, end))
    for number in range(linear.data.graph.size()):
        factor = linear.data.graph.at(number)
        rows = np.concatenate([starts[key] + np.arange(6) for key in list(factor.keys())])
        information[np.ix_(rows, rows)] += factor.information()
    shown = np.einsum("pn,pnij->ij", parts.distortion_weight, parts.distortion_information)
    rows = starts[DISTORTION] + np.arange(3)
    information[np.ix_(rows, rows)] += shown
    for number, (place, camera) in enumerate(model.matched_places):
        edge = model.place_graph.at(model.places + number)
        root = edge.noiseModel().R()
        whitened, _ = edge.linearize(linear.values).jacobian()
        rows = np.concatenate([starts[key] + np.arange(6) for key in list(edge.keys())])
        scatter = root @ parts.scatter_at_place[place, camera] @ root.T
        information[np.ix_(rows, rows)] += whitened.T @ scatter @ whitened
    return np.diag(moved @ information @ moved.T)


def test_the_error_bar_of_more_frames_is_as_predicted(pair: Rig) -> None:
    few = evidence(pair, table(pair, 5, OF_A_SENSOR)).error_sources
    many = evidence(pair, table(pair, 25, OF_A_SENSOR)).error_sources
    for name, before in few.items():
        after = many[name].rotation_deg, many[name].translation_cm
        assert before.rotation_deg > after[0] and before.translation_cm > after[1]
        # Scatter of 15 frames, so of 12 degrees of freedom: sigmas to 20 %, of a part.
        assert before.forecast[5] == pytest.approx(after, rel=0.2)


def test_recording_is_advised_only_where_it_shrinks_the_error_bar_enough(pair: Rig) -> None:
    found = evidence(pair, table(pair, 2, OF_A_SENSOR)).error_sources["left"]
    assert found.describe((0.5, 100.0)).startswith(f"{found.rotation_deg:.2g} deg (1 sigma)")
    best_deg = found.forecast[MOST_TIMES][0]
    wide = found.rotation_deg / 0.3
    assert found.action((1.01 * wide, 100.0)) == ""
    twice = 1.001 * found.forecast[2][0] / 0.3
    assert found.action((twice, 100.0)).startswith("Record 2 times as many frames")
    limited = found.action((0.9 * best_deg / 0.3, 100.0))
    assert "Record" not in limited and limited.startswith("Tolerate more")
    assert f"{best_deg:.2g} deg" in limited
