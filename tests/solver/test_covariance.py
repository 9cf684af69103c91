from __future__ import annotations

import gtsam
import numpy as np

from calibgraph import Rig
from calibgraph.model.geometry import relative_covariance
from calibgraph.solver.covariance import with_pseudo_frames


def test_pseudo_frames_add_the_scatter_without_its_correlations() -> None:
    rng = np.random.default_rng(0)
    hessian = np.diag([4.0, 3.0, 2.0, 1.0])
    gradients = rng.standard_normal((10, 4)) @ rng.standard_normal((4, 4))
    scatter = gradients.T @ gradients
    found = with_pseudo_frames(scatter, hessian, np.full(4, 10.0))
    np.testing.assert_allclose(found, scatter + 6 / 9 * np.diag(np.diag(scatter)))


def test_of_one_frame_the_scatter_is_what_is_usual() -> None:
    """Its own gradient is zero at the solution; along the axes of the Hessian, usual remains."""
    hessian, usual = np.diag([4.0, 3.0, 2.0, 1.0]), np.diag([9.0, 8.0, 7.0, 6.0])
    found = with_pseudo_frames(np.zeros((4, 4)), hessian, np.ones(4), usual)
    np.testing.assert_allclose(found, usual)


def test_of_many_frames_their_own_scatter_remains() -> None:
    rng = np.random.default_rng(0)
    gradients = rng.standard_normal((4000, 4))
    scatter = gradients.T @ gradients
    found = with_pseudo_frames(
        scatter, np.diag([4.0, 3.0, 2.0, 1.0]), np.full(4, 4000.0), 100 * scatter
    )
    np.testing.assert_allclose(found, scatter, rtol=0.02, atol=0.02 * scatter[0, 0])


def test_the_covariance_of_a_pair_is_the_scatter_of_small_steps_of_both_cameras(pair: Rig) -> None:
    rng = np.random.default_rng(1)
    root = 1e-4 * rng.standard_normal((12, 12))
    left, right = (gtsam.Pose3(T) for T in pair.T_camera_lidar.values())
    T_right_left = right.compose(left.inverse())
    steps = rng.standard_normal((4000, 12)) @ root.T
    twists = [
        gtsam.Pose3.Logmap(
            gtsam.Pose3.Expmap(s[6:]).compose(right)
            .compose(gtsam.Pose3.Expmap(s[:6]).compose(left).inverse())
            .compose(T_right_left.inverse())
        )
        for s in steps
    ]  # fmt: skip
    expected = np.cov(np.array(twists), rowvar=False)
    found = relative_covariance(root @ root.T, 0, 1, T_right_left.matrix())
    ratio = np.linalg.eigvals(np.linalg.solve(expected, found)).real
    # A covariance from n draws is off by sqrt(2 / n), 2.2 %, per direction: 4 of these.
    np.testing.assert_allclose(ratio, 1.0, atol=0.09)
