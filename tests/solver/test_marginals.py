"""The covariance and the graph of a solution are those that a calibration reports."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Config, Rig, preset, simulate_correspondences, solve
from calibgraph.solver.joint import solve_joint
from tests.solver.test_camera_pairs import simulated_pairs


@pytest.mark.parametrize("config", [Config(), preset("kitti")])
@pytest.mark.parametrize("tied", [False, True])
def test_a_solution_has_the_covariance_and_graph_of_its_calibration(
    pair: Rig, config: Config, tied: bool
) -> None:
    table = simulate_correspondences(pair, frames=6, matches=80, seed=0)
    matches = simulated_pairs(pair) if tied else None
    solution = solve_joint(pair, table, config, camera_matches=matches)
    result = solve(pair, table, config, camera_matches=matches)
    assert solution.covariance is not None and result.joint_covariance is not None
    np.testing.assert_array_equal(solution.covariance, result.joint_covariance)
    assert str(solution.graph()) == str(result.graph)


def test_without_camera_pairs_a_solution_is_its_own(pair: Rig) -> None:
    table = simulate_correspondences(pair, frames=6, matches=80, seed=0)
    alone = solve_joint(pair, table)
    tied = solve_joint(pair, table, camera_matches=simulated_pairs(pair))
    assert alone.without_pairs() is alone
    assert tied.without_pairs() is tied.without_pairs()
    assert alone.covariance is not None and tied.without_pairs().covariance is not None
    np.testing.assert_allclose(tied.without_pairs().covariance, alone.covariance, rtol=1e-9)
