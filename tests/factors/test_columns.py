"""The block factor with columns of lens, clock, distortion: by differences, and stock factors."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import Clock, Columns, ProjectionBlock, displace, placed_factor, to_runs
from factors.columns import COEFFICIENT_NUMBERS, DISTORTION
from tests.draws.places import distortions_at
from tests.factors.blocks import KEY, LENSES, TRUTH, at, poses, world
from tests.factors.test_block import EACH_LENS_AND_SCALE, together

KEY_CLOUD, KEY_LENS = 6, 8
SIGMAS = {"focal": 0.002, "aspect": 0.001, "centre_x": 2.0, "centre_y": 3.0}
TWIST = np.array([0.05, -0.03, 0.4, 9.0, 0.3, -0.1])
HEIGHT_PX = 480


def free(name: str, *, clock: bool = False) -> Columns:
    """All parameters of a lens, and of its clock."""
    lens = LENSES[name]
    sigmas = SIGMAS | dict.fromkeys(COEFFICIENT_NUMBERS[lens.kind], 0.01)
    if clock:
        sigmas = {"offset": 0.02, **sigmas, "readout": 0.02}
    return Columns(lens, tuple(sigmas), tuple(sigmas.values()), Clock(0.01, 0.005, HEIGHT_PX))


def moving(name: str, count: int) -> ProjectionBlock:
    """Correspondences of a LiDAR that moves, each with its own twist."""
    block, rng = world(LENSES[name], count), np.random.default_rng(2)
    twists = TWIST * rng.uniform(0.5, 1.5, (count, 6))
    return replace(block, motion=np.column_stack([twists, np.zeros(count)]))


def with_lens(pose: gtsam.Pose3, values: np.ndarray) -> gtsam.Values:
    found = at(pose)
    found.insert(KEY_LENS, values)
    found.insert(KEY_CLOUD, gtsam.Pose3())
    return found


@pytest.mark.parametrize(
    ("name", "clock"), [(name, clock) for name in LENSES for clock in (False, True)]
)
def test_derivatives_are_those_of_differences(name: str, clock: bool) -> None:
    lens, rng = free(name, clock=clock), np.random.default_rng(1)
    block = moving(name, 50) if clock else world(LENSES[name], 50)
    values, step = rng.standard_normal(len(lens)), 1e-5
    pose = TRUTH.retract(rng.normal(size=6) / 50)
    T = pose.inverse().matrix()
    columns = block.columns(T, lens, values)
    for number, direction in enumerate(np.eye(6 + len(lens))):
        up, down = (
            block.columns(
                pose.retract(sign * step * direction[:6]).inverse().matrix(),
                lens,
                values + sign * step * direction[6:],
            )[-1]
            for sign in (1, -1)
        )
        # Differences of numbers of size 1e3 px are exact to 1e3 * 1e-16 / 1e-5; their second
        # order is 1e-10 of the largest column.
        limit = 1e-6 * max(1.0, np.abs(columns[number]).max())
        np.testing.assert_allclose(columns[number], (up - down) / (2 * step), atol=limit)


@pytest.mark.parametrize("name", LENSES)
def test_with_the_lens_held_it_is_the_block_factor(name: str) -> None:
    block, lens = world(LENSES[name], 60), free(name)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(placed_factor([KEY_CLOUD, KEY, KEY_LENS], block, lens))
    for pose in poses()[:3]:
        values = with_lens(pose, np.zeros(len(lens)))
        np.testing.assert_allclose(graph.error(values), together(block).error(at(pose)), rtol=1e-9)
        hessian, gradient = together(block).linearize(at(pose)).hessian()
        found = graph.linearize(values).hessian()
        np.testing.assert_allclose(found[0][6:12, 6:12], hessian, atol=1e-9 * np.abs(hessian).max())
        np.testing.assert_allclose(found[1][6:12], gradient, atol=1e-9 * np.abs(gradient).max())


def test_a_displaced_cloud_is_a_displaced_camera() -> None:
    lens = free("radtan")
    factor = placed_factor([KEY_CLOUD, KEY, KEY_LENS], world(LENSES["radtan"], 40), lens)
    values = with_lens(TRUTH, np.full(len(lens), 0.3))
    values.update(KEY_CLOUD, gtsam.Pose3().retract(np.linspace(-0.02, 0.03, 6)))
    graph = gtsam.NonlinearFactorGraph()
    graph.add(factor)
    linear = graph.linearize(values)
    step = 1e-6
    for key, size in ((KEY_CLOUD, 6), (KEY, 6), (KEY_LENS, len(lens))):
        slope = linear.gradientAtZero().at(key)
        for number in range(size):
            moved = step * np.eye(size)[number]
            up, down = (graph.error(moved_by(values, key, s * moved)) for s in (1, -1))
            np.testing.assert_allclose(
                slope[number], (up - down) / (2 * step), rtol=1e-4, atol=1e-2
            )


def moved_by(values: gtsam.Values, key: int, step: np.ndarray) -> gtsam.Values:
    moved = gtsam.Values(values)
    if key == KEY_LENS:
        moved.update(key, values.atVector(key) + step)
    else:
        moved.update(key, values.atPose3(key).retract(step))
    return moved


def test_refuses_parameters_that_a_lens_does_not_have() -> None:
    with pytest.raises(ValueError, match="no free k4"):
        Columns(LENSES["radtan"], ("k4",), (1.0,))


def test_points_that_have_been_moved_are_moved_on() -> None:
    """A block at one clock has the residuals of the recorded points at that clock."""
    free = Columns(LENSES["radtan"], ("offset", "readout"), (0.1, 0.1), Clock(0, 0, HEIGHT_PX))
    block, values, T = moving("radtan", 40), np.array([0.4, -0.3]), TRUTH.inverse().matrix()
    times_s = free.clock_at(values).times_s(block.pixels_px[:, 1])
    points = displace(block.points_lidar_m, block.motion[:, :6], -times_s)
    motion = np.column_stack([block.motion[:, :6], times_s])
    moved = replace(block, points_lidar_m=points, motion=motion)
    recorded, there = (one.columns(T, free, values) for one in (block, moved))
    np.testing.assert_allclose(there, recorded, atol=1e-9 * np.abs(recorded).max())


def test_without_motion_or_at_rest_the_clock_is_not_observable() -> None:
    free = Columns(LENSES["pinhole"], ("offset", "readout"), (0.02, 0.02))
    still = world(LENSES["pinhole"], 20)
    parked = replace(still, motion=np.zeros((20, 7)))
    for block in (still, parked):
        columns = block.columns(TRUTH.inverse().matrix(), free, np.ones(2))
        assert not columns[6:8].any()


def test_the_columns_of_a_scan_distortion_displace_the_points() -> None:
    """By central differences of 1e-6; their third order is far below."""
    for name in LENSES:
        block = world(LENSES[name], 30)
        free, T = Columns(LENSES[name], DISTORTION, (1.0, 0.5, 2.0)), TRUTH.inverse().matrix()
        found = block.columns(T, free)[6:9]
        for column, shift, sigma in zip(
            found, distortions_at(block.points_lidar_m), free.sigmas, strict=True
        ):
            up, down = (
                replace(block, points_lidar_m=block.points_lidar_m + s * 1e-6 * sigma * shift)
                .columns(T)[-1] for s in (1, -1)
            )  # fmt: skip
            limit = 1e-6 * max(1.0, np.abs(column).max())
            np.testing.assert_allclose(column, (up - down) / 2e-6, atol=limit)


@pytest.mark.parametrize(("name", "scale"), EACH_LENS_AND_SCALE)
def test_sums_of_runs_are_those_of_the_columns(name: str, scale: float) -> None:
    """H, b, c, the sums of weights, and the second derivative of c / 2; some points lie behind."""
    block, lens = moving(name, 600).rescale(scale=scale, sigma=0.7), free(name, clock=True)
    edges, step = np.array([0, 300, 300, 600]), 1e-3 * np.ones(6 + len(lens))
    T = np.array([pose.inverse().matrix() for pose in (TRUTH, TRUTH, poses()[3])])
    values = np.full(len(lens), 0.3)
    found = block.summarize(T, to_runs(edges), lens, values, step=step, curvature=True)
    for run, (first, end) in enumerate(to_runs(edges)):
        columns = block.select(np.arange(first, end)).columns(T[run], lens, values)
        columns[-1] += np.tensordot(step, columns[:-1], axes=1)
        rows, residuals = columns[:-1], columns[-1]
        pulls, s = (rows * residuals).sum(axis=1), np.square(residuals).sum(axis=0)
        weights, bend = 1 / (1 + s / scale**2), -2 / scale**2 / (1 + s / scale**2) ** 2  # 2 psi'
        losses = s if np.isinf(scale) else scale**2 * np.log1p(s / scale**2)
        hessian = np.einsum("ain,bin,n->ab", rows, rows, weights)
        unit = np.sqrt(np.diag(hessian)) + 1e-300
        across = np.einsum("an,bn,n->ab", pulls, pulls, bend)
        for mine, expected, limit in (
            (found.hessian[run], hessian, 1e-12), (found.curvature[run], hessian + across, 1e-6)
        ):  # fmt: skip
            np.testing.assert_allclose(
                mine / unit / unit[:, None], expected / unit / unit[:, None], atol=limit
            )
        np.testing.assert_allclose(
            found.gradient[run] / unit, pulls @ weights / unit, rtol=1e-9, atol=1e-9
        )
        sums = losses.sum(), weights.sum(), weights @ s
        mine = found.cost[run], found.weights[run], found.squares[run]
        np.testing.assert_allclose(mine, sums, rtol=1e-12)
