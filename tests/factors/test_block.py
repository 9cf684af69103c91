"""The block factor equals its separate factors: in error, in linearization, in the solution."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import Lens, ProjectionBlock, block_factor, projection_factor, to_runs
from factors.arrays import square_root
from tests.factors.blocks import KEY, LENSES, TRUTH, at, poses, world

EACH_LENS_AND_SCALE = [*((name, 3.0) for name in LENSES), ("radtan", np.inf)]
"""Of the loss; an infinite one is least squares."""


def T_of(pose: gtsam.Pose3) -> np.ndarray:
    return pose.inverse().matrix()[None]


def separate(block: ProjectionBlock) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    roots = block.sqrt_information
    for k in range(len(block)):
        s00, s01, s11 = (1.0, 0.0, 1.0) if roots is None else roots[k]
        graph.add(
            projection_factor(
                KEY,
                block.lens,
                block.points_lidar_m[k],
                block.pixels_px[k],
                sqrt_information=[[s00, s01], [0.0, s11]],
                scale=block.scale,
            )
        )
    return graph


def together(block: ProjectionBlock) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    graph.add(block_factor(KEY, block))
    return graph


def with_weights(block: ProjectionBlock, weights: str) -> ProjectionBlock:
    """The block with no whitening, or with numbers, or with its matrices."""
    numbers = np.random.default_rng(1).uniform(0.2, 2, len(block))
    root = np.column_stack([numbers, np.zeros(len(block)), numbers])
    given = {"none": None, "numbers": root, "matrices": block.sqrt_information}
    return replace(block, sqrt_information=given[weights])


@pytest.mark.parametrize(
    ("name", "scale", "weights", "count"),
    [
        *((*each, "matrices", 60) for each in EACH_LENS_AND_SCALE),
        # A pinhole whose weights are no matrices has a kernel of its own, with tiles.
        *(("pinhole", scale, weights, 600) for scale in (3.0, np.inf)
          for weights in ("numbers", "none")),
        ("radtan", 3.0, "numbers", 60), ("radtan", np.inf, "none", 60),
    ],
)  # fmt: skip
def test_error_and_linearization_equal_the_separate_factors(
    name: str, scale: float, weights: str, count: int
) -> None:
    """At the last pose some points lie behind the camera."""
    block = with_weights(replace(world(LENSES[name], count), scale=scale), weights)
    many, one = separate(block), together(block)
    for pose in poses():
        values = at(pose)
        np.testing.assert_allclose(one.error(values), many.error(values), rtol=1e-9)
        expected = many.linearize(values).hessian()
        found = one.linearize(values).hessian()
        for a, b in zip(found, expected, strict=True):  # (6, 6) and (6,)
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max())


@pytest.mark.parametrize(("name", "scale"), EACH_LENS_AND_SCALE)
def test_the_curvature_is_the_derivative_of_the_gradient(name: str, scale: float) -> None:
    """But for residuals times second derivatives of pixels: 0.01 px are 1e-5 of the focal length.

    A loss bends at 0.03 px, so that the residuals are as wide beside them as usual.
    """
    runs = to_runs(np.array([0, 200, 600]))
    block = replace(world(LENSES[name], 600, outliers=0.0), scale=scale / 100)
    exact = block.pixels_px + block.residuals(T_of(TRUTH))[0]
    block = replace(block, pixels_px=exact + 0.01 * (block.pixels_px - exact))
    sums, steps = block.summarize(T_of(TRUTH), runs, curvature=True), 1e-7 * np.eye(6)
    sides = [
        [block.summarize(T_of(TRUTH.retract(s * d)), runs).gradient for s in (1, -1)] for d in steps
    ]
    for frame, (found, whole) in enumerate(zip(sums.curvature, sums.hessian, strict=True)):
        expected = np.array([ahead[frame] - behind[frame] for ahead, behind in sides]) / 2e-7
        unit = np.outer(*[np.sqrt(np.diag(whole))] * 2)
        np.testing.assert_allclose(found / unit, expected / unit, atol=3e-4)
        away = np.abs((found - whole) / unit).max()
        assert away < 1e-12 if np.isinf(scale) else away > 0.05
    # Of another kernel, which adds in another order.
    np.testing.assert_allclose(
        sums.hessian / whole.max(),
        block.summarize(T_of(TRUTH), runs).hessian / whole.max(),
        atol=1e-13,
    )


def test_far_residuals_do_not_leave_the_range_of_a_float() -> None:
    """The sum of logarithms is taken as that of a product, of weights down to 1e-20 each here."""
    points = np.tile([0.0, 0.0, 1.0], (1001, 1))
    pixels = np.tile([1e6, 0.0], (1001, 1))
    block = ProjectionBlock(
        Lens.of("pinhole", fx=1.0, fy=1.0, cx=0, cy=0), points, pixels, scale=1e-4
    )
    expected = 1001 * 1e-8 * np.log1p(1e20)
    assert float(block.sums(gtsam.Pose3()).cost) == pytest.approx(expected, rel=1e-12)


def solution(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> gtsam.Pose3:
    """LM, then Gauss-Newton until the gradient vanishes: an error known to 1e-16 of itself says
    where its minimum is only to 1e-8 of the pose's sigma."""
    near = gtsam.LevenbergMarquardtOptimizer(graph, start).optimize()
    polish = gtsam.GaussNewtonOptimizer(graph, near)
    for _ in range(40):
        polish.iterate()
    return polish.values().atPose3(KEY)


@pytest.mark.parametrize(("name", "scale"), EACH_LENS_AND_SCALE)
def test_solution_equals_that_of_the_separate_factors(name: str, scale: float) -> None:
    outliers = 0.0 if np.isinf(scale) else 0.2
    block = replace(world(LENSES[name], 80, outliers=outliers), scale=scale)
    start = at(TRUTH.retract(np.full(6, 0.01)))
    many, one = (solution(graph, start) for graph in (separate(block), together(block)))
    np.testing.assert_allclose(one.matrix(), many.matrix(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_points_give_a_singular_but_harmless_factor(count: int) -> None:
    block = world(LENSES["pinhole"], count)
    error, jacobian = square_root(block.sums(poses()[2]))
    sums = block.sums(poses()[2])
    assert np.isfinite(error).all()
    np.testing.assert_allclose(jacobian.T @ jacobian, sums.hessian, atol=1e-9 * sums.hessian.max())
    np.testing.assert_allclose(jacobian.T @ error, sums.gradient, atol=1e-9 * 1e4)
    np.testing.assert_allclose(error @ error, sums.cost, rtol=1e-9)


def test_every_point_behind_the_camera_is_finite_and_bounded() -> None:
    block = world(LENSES["radtan"], 300)
    backwards = TRUTH.compose(gtsam.Pose3(gtsam.Rot3.Ry(np.pi), np.zeros(3)))
    assert not block.residuals(T_of(backwards))[1].any()
    graph = together(block)
    assert np.isfinite(graph.error(at(backwards)))
    found = gtsam.LevenbergMarquardtOptimizer(graph, at(backwards)).optimize()
    assert np.isfinite(found.atPose3(KEY).matrix()).all()
    assert graph.error(found) <= graph.error(at(backwards))


def test_bad_blocks_are_refused() -> None:
    lens = LENSES["pinhole"]
    with pytest.raises(ValueError, match="shape"):
        ProjectionBlock(lens, np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"pixels_px\[1\] is not finite"):
        ProjectionBlock(lens, np.zeros((2, 3)), np.array([[0, 0], [np.nan, 0]]))
    with pytest.raises(ValueError, match="scale"):
        ProjectionBlock(lens, np.zeros((2, 3)), np.zeros((2, 2)), scale=0.0)


def test_a_factor_is_that_of_its_own_block_whatever_was_evaluated_before() -> None:
    """A factor remembers its last pose; another block's factor, and another pose, do not use it."""
    block = world(LENSES["pinhole"], 40)
    part = block.select(np.arange(20))
    factors = {id(b): block_factor(KEY, b) for b in (block, part)}
    for pose in [*poses(), *poses()]:
        for b in (block, part):
            expected = b.sums(pose)
            A, right = factors[id(b)].linearize(at(pose)).jacobian()
            hessian, gradient = A.T @ A, -A.T @ right
            # Of sums of 40 terms, through an eigendecomposition.
            scale = np.abs(expected.hessian).max()
            np.testing.assert_allclose(hessian, expected.hessian, rtol=0, atol=1e-12 * scale)
            largest = np.abs(expected.gradient).max()
            np.testing.assert_allclose(gradient, expected.gradient, rtol=0, atol=1e-9 * largest)
            assert 2 * factors[id(b)].error(at(pose)) == pytest.approx(expected.cost, rel=1e-12)


EDGES = np.array([0, 300, 300, 900, 1000])


def blocks(lens: str) -> list[ProjectionBlock]:
    block = world(LENSES[lens], 1000)
    return [with_weights(block, weights) for weights in ("none", "numbers", "matrices")]


def T_camera_lidar() -> np.ndarray:
    return np.array([pose.inverse().matrix() for pose in poses()[1:]])  # some points lie behind


@pytest.mark.parametrize("lens", LENSES)
def test_runs_at_poses_of_their_own_have_the_sums_of_their_blocks(lens: str) -> None:
    T, scales = T_camera_lidar(), np.array([1.0, 2, 3, 4])
    for block in blocks(lens):
        found = block.summarize(T, to_runs(EDGES), scales=scales)
        for i, (first, end) in enumerate(to_runs(EDGES)):
            part = replace(block.select(np.arange(first, end)), scale=scales[i])
            expected = part.sums(poses()[1 + i])
            assert found.cost[i] == pytest.approx(expected.cost, rel=1e-12)
            most = np.abs(expected.hessian).max(initial=1.0)
            np.testing.assert_allclose(found.hessian[i], expected.hessian, atol=1e-12 * most)
        costs = [block.sums(pose).cost for pose in poses()[1:]]
        np.testing.assert_allclose(block.costs_at_each(T), costs, rtol=1e-12)


@pytest.mark.parametrize("lens", LENSES)
def test_norms_are_those_of_the_residuals_and_infinite_behind_the_camera(lens: str) -> None:
    T = T_camera_lidar()
    T[3] = np.diag([-1.0, 1, -1, 1]) @ T[0]
    for block in blocks(lens):
        norms = block.run_norms(T, to_runs(EDGES))
        residuals, projectable = block.residuals(T, to_runs(EDGES))
        assert (np.isfinite(norms) == projectable).all()
        assert not projectable.all()
        x, y = residuals.T
        a, b, c = (np.ones((1000, 3)) * [1, 0, 1] if block.sqrt_information is None
                   else block.sqrt_information).T  # fmt: skip
        for found, expected in zip(
            norms, (np.hypot(x, y), np.hypot(a * x + b * y, c * y)), strict=False
        ):
            np.testing.assert_allclose(
                found[projectable], expected[projectable], rtol=1e-12, atol=1e-12
            )
