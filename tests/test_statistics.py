"""Many draws: the reported covariance is the scatter of the result. Marked, run apart."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import MatcherErrors, Rig, simulate_correspondences, solve

pytestmark = pytest.mark.statistics

DRAWS = 100


def test_the_covariance_is_the_scatter_over_draws(mixed_rig: Rig) -> None:
    """Errors shared by a frame: (J^T J)^-1 would be too small by far, clusters are not.

    The mean of 100 chi-squared values of 6 degrees, over 6, is 1 +- 0.058; but a covariance from 30
    frames is itself uncertain, which makes the mean larger: 30 / (30 - 6 - 2) = 1.4 at most.
    """
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
    squares: dict[str, list[float]] = {name: [] for name in mixed_rig.cameras}
    for seed in range(DRAWS):
        table = simulate_correspondences(
            mixed_rig, frames=30, matches=100, errors=errors, seed=seed
        )
        result = solve(mixed_rig, table)
        for name, T in result.T_camera_lidar.items():
            truth = gtsam.Pose3(mixed_rig.T_camera_lidar[name])
            xi = gtsam.Pose3.Logmap(gtsam.Pose3(T).compose(truth.inverse()))
            squares[name].append(float(xi @ np.linalg.solve(result.covariance[name], xi)))
    for name, values in squares.items():
        assert 0.8 < np.mean(values) / 6 < 1.6, name
