"""A long drive: the tracker gives the estimate and the covariance of a batch. Run apart."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Config,
    IncrementalCalibrator,
    MatcherErrors,
    Rig,
    perturb,
    simulate_correspondences,
    solve,
)

pytestmark = pytest.mark.statistics


def test_300_frames_give_what_a_batch_gives(mixed_rig: Rig) -> None:
    """Within 0.05 sigma root mean square, and 10 % in the covariance.

    What is left is the hard gate: a match at its edge may be in for one and out for the other.
    """
    guess = perturb(mixed_rig, rotation_deg=1, translation_m=0.1, seed=1)
    errors = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
    table = simulate_correspondences(mixed_rig, frames=300, matches=500, errors=errors, seed=1)
    config = Config(learnt_weights=False)  # the tracker weighs frames alike
    batch, tracker = solve(guess, table, config), IncrementalCalibrator(guess)
    for frame in range(300):
        update = tracker.update(table.select(table.frame == frame))
    apart = []
    for name, T in update.T_camera_lidar.items():
        expected, found = batch.covariance[name], update.covariance[name]
        assert expected is not None and found is not None
        difference = gtsam.Pose3(T).compose(gtsam.Pose3(batch.T_camera_lidar[name]).inverse())
        apart.append(gtsam.Pose3.Logmap(difference) / np.sqrt(np.diag(expected)))
        np.testing.assert_allclose(np.diag(found), np.diag(expected), rtol=0.1)
    assert np.sqrt(np.mean(np.square(apart))) < 0.05
    assert np.abs(apart).max() < 0.1
