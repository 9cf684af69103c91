"""The loss of poses: its gradient through the optimum is that of solving again."""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np
import pytest

from calibgraph import CalibrationError, Rig
from calibgraph.graph.objective import pose_key
from calibgraph.model.geometry import relative_transform
from calibgraph.solver.pose_loss import PoseLoss, pose_loss
from factors import ProjectionBlock, relative_pose_factor
from tests.conftest import points_in_front

STEP = 1e-3  # px, and of the logarithm of a weight


def matches_of(
    rig: Rig, rng: np.random.Generator, *, count: int = 30
) -> dict[str, ProjectionBlock]:
    """Matches with a pixel of noise and some outliers, as both cameras look ahead."""
    blocks = {}
    for name, camera in rig.cameras.items():
        points, T = points_in_front(rng, count), camera.T_camera_lidar
        pixels, _ = camera.lens.project(points @ T[:3, :3].T + T[:3, 3])
        noise = rng.standard_normal((count, 2)) * np.where(rng.random((count, 1)) < 0.2, 8, 1)
        blocks[name] = ProjectionBlock(camera.lens, points, pixels + noise, scale=3.0)
    return blocks


def known_relative_pose(rig: Rig) -> gtsam.NonlinearFactorGraph:
    a, b = rig.cameras
    graph, T = gtsam.NonlinearFactorGraph(), rig.T_camera_lidar
    keys = [pose_key(list(rig.cameras), name) for name in (a, b)]
    T_a_b = relative_transform(T[a], T[b])
    graph.add(relative_pose_factor(*keys, T_a_b, rotation_sigma_rad=1e-3, translation_sigma_m=2e-3))
    return graph


def changed(
    blocks: Mapping[str, ProjectionBlock], name: str, row: int, by: tuple[float, float, float]
) -> dict[str, ProjectionBlock]:
    """The blocks with one match moved by two pixels and its weight's logarithm by a third."""
    block = blocks[name]
    pixels, roots = np.array(block.pixels_px), np.tile([1.0, 0.0, 1.0], (len(block), 1))
    pixels[row] += by[:2]
    roots[row] *= np.exp(by[2])
    moved = ProjectionBlock(block.lens, block.points_lidar_m, pixels, roots, scale=block.scale)
    return {**blocks, name: moved}


@pytest.mark.parametrize("name", ["left", "right"])
def test_the_gradient_is_that_of_solving_again(pair: Rig, name: str) -> None:
    """Of the right camera, also through the known relative pose to the left one's error."""
    blocks = matches_of(pair, np.random.default_rng(0))
    others, truth = known_relative_pose(pair), pair.T_camera_lidar

    def value(row: int, axis: int, step: float) -> float:
        by = [0.0, 0.0, 0.0]
        by[axis] = step
        return pose_loss(changed(blocks, name, row, (by[0], by[1], by[2])), others, truth).value

    found = pose_loss(blocks, others, truth)
    by_data = np.column_stack([found.by_pixels[name], found.by_log_weights[name]])
    rows = range(0, 30, 6)
    differences = [
        [(value(row, axis, STEP) - value(row, axis, -STEP)) / (2 * STEP) for axis in range(3)]
        for row in rows
    ]
    # The minimum repeats to 1e-10 of the cost, and the cost is flat there: its pose is good to some
    # 1e-5 standard deviations, and a difference to 1e-5 / (2 STEP). The gradient is about one.
    np.testing.assert_allclose(by_data[[*rows]], differences, atol=5e-3)
    assert np.abs(by_data).max() > 0.1


def step_down(blocks: Mapping[str, ProjectionBlock], found: PoseLoss) -> dict[str, ProjectionBlock]:
    """The blocks with all pixels moved along the gradient, by a tenth of a pixel at most."""
    most = max(np.abs(of).max() for of in found.by_pixels.values())
    return {
        name: ProjectionBlock(
            block.lens,
            block.points_lidar_m,
            block.pixels_px - 0.1 / most * found.by_pixels[name],
            scale=block.scale,
        )
        for name, block in blocks.items()
    }


def test_following_the_gradient_of_the_pixels_lowers_the_error(pair: Rig) -> None:
    blocks = matches_of(pair, np.random.default_rng(1))
    others, truth = known_relative_pose(pair), pair.T_camera_lidar
    first = last = pose_loss(blocks, others, truth)
    for _ in range(20):
        blocks = step_down(blocks, last)
        last = pose_loss(blocks, others, truth)

    def error_m(of: PoseLoss) -> float:
        T = [relative_transform(of.T_camera_lidar[n], truth[n]) for n in truth]
        return float(np.linalg.norm([each[:3, 3] for each in T]))

    assert last.value < first.value
    assert error_m(last) < error_m(first) / 2


def test_too_few_matches_are_refused(pair: Rig) -> None:
    blocks = {n: b.select(np.array([0, 1])) for n, b in matches_of(
        pair, np.random.default_rng(2)).items()}  # fmt: skip
    with pytest.raises(CalibrationError, match="do not determine"):
        pose_loss(blocks, gtsam.NonlinearFactorGraph(), pair.T_camera_lidar)
