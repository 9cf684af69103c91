"""Many draws: the reported covariance is the scatter of the result. Marked, run apart."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from calibgraph import MatcherErrors, Rig, simulate_correspondences, solve

pytestmark = pytest.mark.statistics

DRAWS = 200


def error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """xi in estimate = exp(xi) truth."""
    return gtsam.Pose3.Logmap(gtsam.Pose3(estimate @ np.linalg.inv(truth)))


@pytest.mark.parametrize("frames", [6, 30])
def test_the_covariance_is_the_scatter_over_draws(pair: Rig, frames: int) -> None:
    """Errors shared by a frame: (J^T J)^-1 would be too small by far, clusters are not.

    With few frames the allowance for what they leave unsaid makes the error bar wide: never too
    small, but down to 0.5 in the mean.
    """
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=1.0, outlier_share=0.15)
    squares: dict[str, list[float]] = {"left": [], "right": [], "left->right": []}
    for seed in range(DRAWS):
        table = simulate_correspondences(pair, frames=frames, matches=100, errors=errors, seed=seed)
        result = solve(pair, table)
        found, true = result.T_camera_lidar, pair.T_camera_lidar
        for name in ("left", "right"):
            xi = error(found[name], true[name])
            squares[name].append(float(xi @ np.linalg.solve(result.covariance[name], xi)))
        xi = error(
            found["right"] @ np.linalg.inv(found["left"]),
            true["right"] @ np.linalg.inv(true["left"]),
        )
        of_pair = result.pair_covariance["left->right"]
        squares["left->right"].append(float(xi @ np.linalg.solve(of_pair, xi)))
    for name, values in squares.items():
        inside = np.mean(np.array(values) < chi2.ppf(0.95, 6))
        if frames == 30:
            assert 0.7 < np.mean(values) / 6 < 1.4, name
            assert 0.9 <= inside <= 0.98, name
        else:
            assert 0.5 < np.mean(values) / 6 < 1.4, name
            assert inside >= 0.9, name
