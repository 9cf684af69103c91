"""The histogram of residuals, and the gate's share of the Hessian."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph import (
    Config,
    Correspondences,
    MatcherErrors,
    Rig,
    simulate_correspondences,
)
from calibgraph.solver.block_residuals import BlockResiduals
from calibgraph.solver.camera_block import CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.noise import ResidualHistogram

Array = np.ndarray


ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)


def matches_of(rig: Rig, table: Correspondences, name: str) -> CameraBlock:
    kept = preprocess(rig, table, Config())
    return camera_blocks(rig, kept.table, Config())[name]


def test_the_histogram_finds_the_scale_of_all_frames(pair: Rig) -> None:
    """Its bins are 1 % wide and values within them are taken as even: 0.3 % is a third of one."""
    table = simulate_correspondences(pair, frames=40, matches=300, errors=ERRORS, seed=5)
    T = pair.T_camera_lidar["left"]
    spread = ResidualHistogram()
    for frame in range(40):
        block = matches_of(pair, table.select(table.frame == frame), "left")
        spread = spread.add(BlockResiduals.at(T, block))
    expected = matches_of(pair, table, "left").scale(T, Config())
    found = spread.scale(Config())
    assert found.sigma_px == pytest.approx(expected.sigma_px, rel=3e-3)
    assert found.gate_px == pytest.approx(expected.gate_px, rel=3e-3)


def test_the_gates_share_of_the_hessian_is_that_of_moved_gates(pair: Rig) -> None:
    """By differences: 60,000 matches, 2 % of them near the edge, so about 1 / sqrt(1200) = 3 %;

    of a band that the two take differently: within 15 %.
    """
    errors = MatcherErrors(noise_px=1.0, outlier_share=0.3)
    table = simulate_correspondences(pair, frames=60, matches=1000, errors=errors, seed=6)
    matches = matches_of(pair, table, "left")
    T = pair.T_camera_lidar["left"]
    scale = matches.scale(T, Config())
    pose = gtsam.Pose3(T).inverse()
    added = BlockResiduals.at(T, matches).gate_hessians(scale)[0]
    for axis in range(3):
        step = np.zeros(6)
        step[axis] = 4e-4  # 0.3 px, as wide as the band
        pulls = [
            matches.without_outliers(pose.retract(way * step).inverse().matrix(), scale)
            .with_scale(scale)
            .sums(pose)
            .gradient
            for way in (1, -1)
        ]
        by_differences = (pulls[0] - pulls[1])[axis] / (2 * step[axis])
        assert added[axis, axis] == pytest.approx(by_differences, rel=0.15)
