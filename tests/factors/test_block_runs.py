"""Sums, costs and norms at many poses are those of a block at each of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factors import ProjectionBlock, to_runs
from tests.factors.blocks import LENSES, poses, with_loss, world

EDGES = np.array([0, 300, 300, 900, 1000])


def blocks(lens: str) -> list[ProjectionBlock]:
    """Without whitening, with numbers, and with matrices."""
    matrices = with_loss(world(LENSES[lens], 1000), "cauchy")
    numbers = np.random.default_rng(1).uniform(0.2, 2, 1000)
    root = np.column_stack([numbers, np.zeros(1000), numbers])
    return [replace(matrices, sqrt_information=given) for given in (None, root)] + [matrices]


def T_camera_lidar() -> np.ndarray:
    return np.array([pose.inverse().matrix() for pose in poses()[1:]])  # some points lie behind


@pytest.mark.parametrize("lens", LENSES)
def test_runs_at_poses_of_their_own_have_the_sums_of_their_blocks(lens: str) -> None:
    T, scales = T_camera_lidar(), np.array([1.0, 2, 3, 4])
    for block in blocks(lens):
        found = block.run_sums(T, to_runs(EDGES), scales)
        for i, (first, end) in enumerate(to_runs(EDGES)):
            part = replace(block.select(np.arange(first, end)), scale=scales[i])
            expected = part.sums(poses()[1 + i])
            assert found.cost[i] == pytest.approx(expected.cost, rel=1e-12)
            most = np.abs(expected.hessian).max(initial=1.0)
            np.testing.assert_allclose(found.hessian[i], expected.hessian, atol=1e-12 * most)


@pytest.mark.parametrize("lens", LENSES)
def test_a_block_at_many_poses_has_the_gradients_and_costs_of_each(lens: str) -> None:
    for block in blocks(lens):
        each = [block.sums(pose) for pose in poses()[1:]]
        gradients = np.array([one.gradient for one in each])
        most = np.abs(gradients).max()  # sums in another order: rounding alone
        found = block.gradients_at_each(T_camera_lidar())
        np.testing.assert_allclose(found, gradients, rtol=0, atol=1e-13 * most)
        costs = block.costs_at_each(T_camera_lidar())
        np.testing.assert_allclose(costs, [one.cost for one in each], rtol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_norms_are_those_of_the_residuals_and_infinite_behind_the_camera(lens: str) -> None:
    T = T_camera_lidar()
    T[3] = np.diag([-1.0, 1, -1, 1]) @ T[0]
    for block in blocks(lens):
        norms = block.run_norms(T, to_runs(EDGES), factor=0.5)
        residuals, projectable = block.run_residuals(T, to_runs(EDGES))
        assert (np.isfinite(norms) == projectable).all()
        assert projectable.all() == (lens == "equirectangular")  # a panorama sees behind
        x, y = residuals.T
        a, b, c = (np.ones((1000, 3)) * [1, 0, 1] if block.sqrt_information is None
                   else block.sqrt_information).T  # fmt: skip
        for found, expected in zip(
            norms, (np.hypot(x, y), np.hypot(a * x + b * y, c * y)), strict=False
        ):
            np.testing.assert_allclose(
                found[projectable], 0.5 * expected[projectable], rtol=1e-12, atol=1e-12
            )
