"""The errors behind the pictures, the arrows of their means, and the worked point."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from calibgraph import Calibration
from calibgraph.report.camera_section import worked_point
from calibgraph.report.plots import ARROW_COLUMNS, arrow_factor, mean_residuals
from calibgraph.report.reprojection_errors import constrained, errors_before_after
from calibgraph.solver.whitening import constrained_error_px


def test_vectors_of_edges_have_the_length_that_the_gate_compares() -> None:
    rng = np.random.default_rng(0)
    residuals, normals = rng.normal(0, 3, (2, 50, 2))
    edges = np.column_stack(
        [normals[:, 0] ** 2, normals[:, 0] * normals[:, 1], normals[:, 1] ** 2]
    ) + np.outer(rng.integers(0, 2, 50), [0.5, 0.1, 0.7])
    lengths = np.hypot(*constrained(residuals, edges).T)
    np.testing.assert_allclose(lengths, constrained_error_px(residuals, edges), atol=1e-9)
    np.testing.assert_array_equal(constrained(residuals, None), residuals)


def test_errors_are_those_at_the_guess_and_at_the_result(
    pair_without_outliers: Calibration,
) -> None:
    result = pair_without_outliers
    left = errors_before_after(result)["left"]
    # The median of 1600 two-dimensional errors of 1 px per axis is 1.177 px, to some 2 percent.
    assert np.median(left.after.sizes_px) == pytest.approx(1.177, rel=0.1)
    assert np.median(left.before.sizes_px) > 10 * np.median(left.after.sizes_px)
    assert np.median(left.after.sizes_px) == pytest.approx(result.residuals["left"].median_px)
    assert abs(np.count_nonzero(left.after.is_inlier) - result.counts["left"]["used"]) < 10


def test_arrows_are_the_mean_of_their_cell(solved_pair: Calibration) -> None:
    after = errors_before_after(solved_pair)["left"].after
    shifted = replace(after, vectors_px=np.tile([0.5, -0.25], (len(after.frame), 1)))
    camera = solved_pair.rig.cameras["left"]
    _, means, cell_px = mean_residuals(camera, shifted, ARROW_COLUMNS)
    assert len(means) > 0
    np.testing.assert_allclose(means, np.tile([0.5, -0.25], (len(means), 1)))
    assert 0.3 * cell_px < arrow_factor(means, cell_px) * np.hypot(0.5, 0.25) <= 0.9 * cell_px


def test_the_worked_point_is_right(pair_without_outliers: Calibration) -> None:
    camera = pair_without_outliers.rig.cameras["left"]
    worked = worked_point(camera, errors_before_after(pair_without_outliers)["left"].after)
    numbers = {
        line.split("=")[0].strip(): [float(n) for n in re.findall(r"-?\d+\.\d+", line)]
        for line in worked.splitlines()
    }
    T = camera.T_camera_lidar
    p_camera = T[:3, :3] @ numbers["p_lidar"] + T[:3, 3]
    np.testing.assert_allclose(numbers["p_camera"], p_camera, atol=2e-3)
    u, v = numbers["projected pixel (u, v)"]
    # x and z have three digits, at about 10 m: half a millimetre is 0.04 px.
    np.testing.assert_allclose(camera.lens.project(p_camera[None])[0][0], (u, v), atol=0.1)
    matched_u, matched_v, size = numbers["matched pixel"]
    assert np.hypot(u - matched_u, v - matched_v) == pytest.approx(size, abs=0.02)
