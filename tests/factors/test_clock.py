"""The clock among the parameters of the block factor: by differences, and by GTSAM's factors."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import Clock, FreeLens, FreeLensBlock, ProjectionBlock, displace, free_lens_factor
from tests.factors.blocks import KEY, LENSES, TRUTH, K, at, world
from tests.factors.test_free_lens import KEY_LENS, with_lens

TWIST = np.array([0.05, -0.03, 0.4, 9.0, 0.3, -0.1])
HEIGHT_PX = 480


def moving(name: str, count: int, *, alike: bool = False) -> ProjectionBlock:
    """Correspondences of a LiDAR that moves, each with its own twist."""
    block, rng = world(LENSES[name], count), np.random.default_rng(2)
    twists = TWIST * (np.ones((count, 1)) if alike else rng.uniform(0.5, 1.5, (count, 6)))
    return replace(block, motion=np.column_stack([twists, np.zeros(count)]))


@pytest.mark.parametrize(
    ("name", "of_lens"),
    [
        *((name, ()) for name in LENSES),
        *((name, ("focal", "k1")) for name in LENSES if name != "equirectangular"),
    ],
)
def test_derivatives_are_those_of_differences(name: str, of_lens: tuple[str, ...]) -> None:
    parameters = ("offset", *of_lens, "readout")
    free = FreeLens(
        LENSES[name], parameters, (0.02,) * len(parameters), Clock(0.01, 0.005, HEIGHT_PX)
    )
    block = FreeLensBlock(moving(name, 50), free)
    values, T, step = np.full(len(free), 0.3), TRUTH.inverse().matrix(), 1e-5
    columns = block.columns(T, values)
    for number, direction in enumerate(step * np.eye(len(free)), start=6):
        up, down = (block.columns(T, values + sign * direction)[-1] for sign in (1, -1))
        # As of the lens: digits of 1e3 px, and a second order of 1e-10 of the largest column.
        limit = 1e-6 * max(1.0, np.abs(columns[number]).max())
        np.testing.assert_allclose(columns[number], (up - down) / (2 * step), atol=limit)


def test_equals_factors_of_gtsam_on_a_camera_that_moves_on() -> None:
    """Stock factors on the pose exp(xi t) X of the camera at the time of its image."""
    block = replace(moving("pinhole", 20, alike=True), sqrt_information=None, loss="l2")
    free = FreeLens(LENSES["pinhole"], ("offset",), (1.0,))
    ours, theirs = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    ours.add(free_lens_factor([KEY, KEY_LENS], FreeLensBlock(block, free)))
    calibration = gtsam.Cal3_S2(K["fx"], K["fy"], 0.0, K["cx"], K["cy"])
    pose, late = TRUTH.retract(np.full(6, 0.01)), 0.05
    moved = gtsam.Pose3.Expmap(late * TWIST) * pose
    values = at(moved)
    for number, (point, pixel) in enumerate(
        zip(block.points_lidar_m, block.pixels_px, strict=True), start=100
    ):
        values.insert(number, point)
        theirs.add(
            gtsam.GenericProjectionFactorCal3_S2(
                pixel, gtsam.noiseModel.Unit.Create(2), KEY, number, calibration
            )
        )
    order = gtsam.Ordering()
    for key in [KEY, *range(100, 120)]:
        order.push_back(key)
    hessian, gradient = (part[:6, ...] for part in theirs.linearize(values).hessian(order))
    chain = np.column_stack([np.eye(6), moved.inverse().AdjointMap() @ TWIST])
    here = with_lens(pose, np.array([late]))
    keys = gtsam.Ordering()
    for key in (KEY, KEY_LENS):
        keys.push_back(key)
    found = ours.linearize(here).hessian(keys)
    np.testing.assert_allclose(2 * ours.error(here), 2 * theirs.error(values), rtol=1e-9)
    expected = chain.T @ hessian[:, :6] @ chain
    np.testing.assert_allclose(found[0], expected, atol=1e-9 * np.abs(expected).max())
    pulled = chain.T @ gradient
    np.testing.assert_allclose(found[1], pulled, atol=1e-9 * np.abs(pulled).max())


def test_points_that_have_been_moved_are_moved_on() -> None:
    """A block at one clock has the residuals of the recorded points at that clock."""
    free = FreeLens(LENSES["radtan"], ("offset", "readout"), (0.1, 0.1), Clock(0, 0, HEIGHT_PX))
    block, values, T = moving("radtan", 40), np.array([0.4, -0.3]), TRUTH.inverse().matrix()
    times_s = free.clock_at(values).times_s(block.pixels_px[:, 1])
    assert block.motion is not None
    points = displace(block.points_lidar_m, block.motion[:, :6], -times_s)
    motion = np.column_stack([block.motion[:, :6], times_s])
    moved = replace(block, points_lidar_m=points, motion=motion)
    recorded, there = (FreeLensBlock(one, free).columns(T, values) for one in (block, moved))
    np.testing.assert_allclose(there, recorded, atol=1e-9 * np.abs(recorded).max())


def test_displacement_is_that_of_the_exponential() -> None:
    points = np.random.default_rng(3).normal(0, 20, (30, 3))
    for rate in (1.0, 1e-4, 0.0):
        twist = TWIST * [rate, rate, rate, 1, 1, 1]
        T = gtsam.Pose3.Expmap(0.3 * twist).matrix()
        expected = points @ T[:3, :3].T + T[:3, 3]
        np.testing.assert_allclose(displace(points, twist, 0.3), expected, atol=1e-9)


def test_without_motion_or_at_rest_the_clock_is_not_observable() -> None:
    free = FreeLens(LENSES["pinhole"], ("offset", "readout"), (0.02, 0.02))
    still = world(LENSES["pinhole"], 20)
    parked = replace(still, motion=np.zeros((20, 7)))
    for block in (still, parked):
        columns = FreeLensBlock(block, free).columns(TRUTH.inverse().matrix(), np.ones(2))
        assert not columns[6:8].any()


def test_the_motion_stays_with_its_correspondences() -> None:
    block, rows = moving("pinhole", 12), np.array([7, 2, 5])
    assert block.motion is not None
    parts = [block.select(rows), block.select(np.arange(3)).rewhiten(None)]
    expected = block.motion[[*rows, 0, 1, 2]]
    joined = ProjectionBlock.join(parts)
    np.testing.assert_array_equal(joined.motion, expected)
    assert ProjectionBlock.join([world(LENSES["pinhole"], 4)] * 2).motion is None
