"""Factors of a pair of cameras: blocks equal separate factors, derivatives and literal formulas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import (
    Lens,
    PairBlock,
    ProjectionBlock,
    cauchy_noise,
    pair_block_factor,
    placed_factor,
    projection_residual,
    ray_spreads,
    unproject,
)
from factors.pose import custom_factor
from tests.conftest import KANNALA, RADTAN5
from tests.draws.cameras import FORWARD

Array = np.ndarray
Residual = Callable[[gtsam.Pose3, gtsam.Pose3], tuple[Array, Array]]
"""Of T_lidar_a and T_lidar_b: the residual [px] of one feature, and its derivative (n, 12)."""

A, B = 3, 8
K = {"fx": 718.0, "fy": 710.0, "cx": 607.0, "cy": 185.0}
LENSES = {
    "pinhole": (Lens.of("pinhole", **K), Lens.of("pinhole", **K, distortion=RADTAN5)),
    "fisheye": (
        Lens.of("fisheye", **K, distortion=KANNALA),
        Lens.of("fisheye", **K, distortion=KANNALA),
    ),
    "mixed": (
        Lens.of("pinhole", **K, distortion=RADTAN5),
        Lens.of("fisheye", **K, distortion=KANNALA),
    ),
}

T_LIDAR_A = gtsam.Pose3(gtsam.Rot3(FORWARD.T), np.array([0.3, 0.1, -0.1]))
T_LIDAR_B = T_LIDAR_A.compose(
    gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.15, 0.01), np.array([0.5, 0.02, -0.05]))
)


def pair_chain(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> Array:
    """(6, 12) derivative of the tangent of ``T_a_b`` by the tangents of both poses."""
    return np.hstack([-T_lidar_b.between(T_lidar_a).AdjointMap(), np.eye(6)])


def plain_factor(noise: gtsam.noiseModel.Base, residual: Residual) -> gtsam.CustomFactor:
    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        error, jacobian = residual(values.atPose3(A), values.atPose3(B))
        return error, [jacobian[:, :6], jacobian[:, 6:]]

    return custom_factor(noise, [A, B], linearize)


class Features:
    """Features of a street of planes, with 0.5 px noise and a fifth of outliers."""

    def __init__(self, lenses: tuple[Lens, Lens], count: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self.lenses = lens_a, lens_b = lenses
        plane_rays = np.column_stack([rng.uniform(-0.7, 0.7, count), rng.uniform(-0.2, 0.2, count)])
        points_a = np.column_stack([plane_rays, np.ones(count)]) * rng.uniform(4, 40, (count, 1))
        self.pixels_a = lens_a.project(points_a)[0]
        self.rays_a = unproject(lens_a, self.pixels_a)[0]
        self.points_a = points_a
        self.points_lidar = np.array([T_LIDAR_A.transformFrom(p) for p in points_a])
        normals = rng.standard_normal((count, 3)) - 2 * self.points_lidar / np.linalg.norm(
            self.points_lidar, axis=1, keepdims=True
        )
        across = np.einsum("ni,ni->n", normals, self.points_lidar)
        self.planes = normals / across[:, None]
        in_b = np.array([T_LIDAR_B.transformTo(p) for p in self.points_lidar])
        self.pixels_b = lens_b.project(in_b)[0] + 0.5 * rng.standard_normal((count, 2))
        wrong = rng.random(count) < 0.2
        self.pixels_b[wrong] += rng.uniform(-40, 40, (np.count_nonzero(wrong), 2))

    def separate(self, kind: str, scale: float) -> gtsam.NonlinearFactorGraph:
        """A factor of GTSAM for each feature, with its residual in numpy."""
        graph = gtsam.NonlinearFactorGraph()
        unit = gtsam.noiseModel.Unit.Create(1 if kind == "epipolar" else 2)
        noise = cauchy_noise(unit, scale)
        for n in range(len(self.pixels_b)):
            graph.add(plain_factor(noise, self.residual(kind, n)))
        return graph

    def residual(self, kind: str, n: int) -> Residual:
        lens, pixel = self.lenses[1], self.pixels_b[n]
        if kind == "epipolar":
            rays = (self.rays_a[n], unproject(lens, pixel)[0][0])
            return epipolar_residual(self.lenses, rays)
        if kind == "surface":
            return surface_residual(lens, self.rays_a[n], self.planes[n], pixel)

        def of_point(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
            T_a_b = T_lidar_a.between(T_lidar_b)
            error, jacobian = projection_residual(lens, T_a_b, self.points_a[n], pixel)
            return error, jacobian @ pair_chain(T_lidar_a, T_lidar_b)

        return of_point

    def block(self, kind: str, scale: float = 2.0) -> PairBlock | ProjectionBlock:
        if kind == "epipolar":
            made = PairBlock.epipolar(*self.lenses, self.pixels_a, self.pixels_b)
            return replace(made, scale=scale)
        lens = self.lenses[1]
        if kind == "surface":
            made = PairBlock.of_surfaces(lens, self.rays_a, self.planes, self.pixels_b)
            return replace(made, scale=scale)
        return ProjectionBlock(lens, self.points_a, self.pixels_b, scale=scale)


def skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def surface_residual(lens_b: Lens, ray_a: Array, plane_per_m: Array, pixel_b_px: Array) -> Residual:
    """Of a feature on a surface q, with q . p = 1 for its points p in the LiDAR frame."""

    def residual(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
        poses = T_lidar_a, T_lidar_b
        (R_a, c_a), (R_b, c_b) = ((each.rotation().matrix(), each.translation()) for each in poses)
        g, k = R_a.T @ plane_per_m, 1.0 - plane_per_m @ c_a
        w = g @ ray_a / k
        R_b_a, t = R_b.T @ R_a, R_b.T @ (c_a - c_b)
        y = R_b_a @ ray_a + w * t
        by_a = [
            -R_b_a @ skew(ray_a) + np.outer(t, np.cross(ray_a, g)) / k,
            w * R_b_a + w * np.outer(t, g) / k,
        ]
        pixel, by_point = lens_b.project_with_jacobian(y)
        by_poses = np.hstack([*by_a, skew(y), -w * np.eye(3)])
        return pixel[0] - pixel_b_px, by_point[0] @ by_poses

    return residual


def epipolar_residual(lenses: tuple[Lens, Lens], rays: tuple[Array, Array]) -> Residual:
    """Sampson's residual of a feature without depth."""
    ray_a, ray_b = rays
    spread_a, spread_b = (
        ray_spreads(lens, ray[None])[0] for lens, ray in zip(lenses, rays, strict=True)
    )

    def residual(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
        T_a_b = T_lidar_a.between(T_lidar_b)
        R, t = T_a_b.rotation().matrix(), T_a_b.translation()

        def form(x: Array, y: Array) -> tuple[float, Array]:
            """C(x, y) and its derivative: d(R y) = R (omega x y), d t = R v."""
            turned, normal = R @ y, np.cross(x, t)
            by_rotation, by_translation = np.cross(y, R.T @ normal), R.T @ np.cross(turned, x)
            return float(normal @ turned), np.concatenate([by_rotation, by_translation])

        value, derivative = form(ray_a, ray_b)
        sides = [form(side, ray_b) for side in spread_a.T]
        sides += [form(ray_a, side) for side in spread_b.T]
        square = sum(c * c for c, _ in sides)
        half_of_square = np.sum([c * d for c, d in sides], axis=0)
        over = 1.0 / np.sqrt(square)
        jacobian = over * (derivative - value / square * half_of_square)
        return np.array([value * over]), jacobian[None] @ pair_chain(T_lidar_a, T_lidar_b)

    return residual


KINDS = ("point", "surface", "epipolar")


def near_truth(seed: int = 1) -> gtsam.Values:
    """Poses a degree and some centimetres off."""
    rng, values = np.random.default_rng(seed), gtsam.Values()
    for key, pose in ((A, T_LIDAR_A), (B, T_LIDAR_B)):
        values.insert(key, pose.retract(rng.normal(0, 0.02, 6)))
    return values


def linearized(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[float, np.ndarray]:
    """Error, and the augmented Hessian over both poses."""
    ordering = gtsam.Ordering()
    ordering.push_back(A)
    ordering.push_back(B)
    return graph.error(values), graph.linearize(values).augmentedHessian(ordering)


@pytest.mark.parametrize(
    ("lenses", "scale"), [("mixed", 2.0), ("mixed", np.inf), ("pinhole", 2.0), ("fisheye", 2.0)]
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_block_equals_its_separate_factors(kind: str, scale: float, lenses: str) -> None:
    features, values = Features(LENSES[lenses], 60), near_truth()
    one = gtsam.NonlinearFactorGraph()
    block = features.block(kind, scale)
    of_points = isinstance(block, ProjectionBlock)  # which are in the frame of A
    one.add(placed_factor([A, B], block) if of_points else pair_block_factor(A, B, block))
    error, hessian = linearized(one, values)
    expected_error, expected = linearized(features.separate(kind, scale), values)
    assert error == pytest.approx(expected_error, rel=1e-9)
    units = np.sqrt(np.maximum(np.diag(expected), 1e-300))
    # The last row is the gradient, and the last entry the sum of weighted squares (not the error).
    assert np.abs((hessian - expected)[:, :12] / np.outer(units, units)[:, :12]).max() < 1e-9


@pytest.mark.parametrize("scale", [1e-7, 1.0], ids=["near identity", "large angles"])
@pytest.mark.parametrize("kind", KINDS)
def test_jacobians_against_differences(kind: str, scale: float) -> None:
    """Of one factor each, at relative poses near the identity and far from it."""
    rng = np.random.default_rng(4)
    features = Features(LENSES["mixed"], 4)
    graph = features.separate(kind, np.inf)
    truth = T_LIDAR_A.between(T_LIDAR_B)
    twist = np.concatenate([scale * rng.normal(0, 0.3, 3), rng.normal(0, 0.3, 3)])
    T_lidar_a = gtsam.Pose3.Expmap(rng.normal(0, 1, 6)) if kind != "surface" else T_LIDAR_A
    values = gtsam.Values()
    values.insert(A, T_lidar_a)
    values.insert(B, T_lidar_a.compose(truth if kind == "surface" else gtsam.Pose3.Expmap(twist)))
    for n in range(graph.size()):
        factor = graph.at(n)
        jacobian = factor.linearize(values).jacobian()[0]
        for i in range(12):
            residuals = []
            for sign in (1, -1):
                moved, key = gtsam.Values(values), (A, B)[i // 6]
                moved.update(key, values.atPose3(key).retract(sign * 1e-6 * np.eye(6)[i % 6]))
                residuals.append(factor.unwhitenedError(moved))
            difference = (residuals[0] - residuals[1]) / 2e-6
            assert difference == pytest.approx(jacobian[:, i], rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("lenses", LENSES.values(), ids=LENSES)
def test_residuals_equal_the_literal_formula(lenses: tuple[Lens, Lens]) -> None:
    """pi_b(T_b T_a^-1 X_a) - u_b with plain matrices; X_a on the ray, where it meets the plane."""
    features, values = Features(lenses, 40), near_truth(seed=3)
    T_a, T_b = (np.linalg.inv(values.atPose3(key).matrix()) for key in (A, B))
    R, center = T_a[:3, :3], -T_a[:3, :3].T @ T_a[:3, 3]
    for kind in ("point", "surface"):
        block = features.block(kind)
        for n in range(len(block)):
            X_a = features.points_a[n]
            if kind == "surface":
                outwards, q = R.T @ features.rays_a[n], features.planes[n]
                hit = center + (1 - q @ center) / (q @ outwards) * outwards
                X_a = (T_a @ [*hit, 1])[:3]
            X_b = (T_b @ np.linalg.inv(T_a) @ [*X_a, 1])[:3]
            expected = features.lenses[1].project(X_b)[0][0] - features.pixels_b[n]
            factor = features.separate(kind, np.inf).at(n)
            assert factor.unwhitenedError(values) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("kind", ["surface", "epipolar"])
def test_runs_have_the_sums_of_their_features_at_poses_of_their_own(kind: str) -> None:
    rng, edges = np.random.default_rng(3), np.array([0, 70, 70, 90, 100])  # more than a tile
    block = Features(LENSES["mixed"], 100).block(kind).rescale(scale=2.0, sigma=0.7)
    poses = [
        tuple(pose.retract(rng.normal(0, 0.02, 6)) for pose in (T_LIDAR_A, T_LIDAR_B))
        for _ in edges[1:]
    ]
    T_lidar_a, T_lidar_b = (np.stack([each[k].matrix() for each in poses]) for k in (0, 1))
    found = block.run_sums(T_lidar_a, T_lidar_b, edges)
    for run, (first, end) in enumerate(pairwise(edges)):
        expected = block.select(np.arange(first, end)).sums(*poses[run])
        assert found.cost[run] == pytest.approx(expected.cost, rel=1e-12)
        for one, two in zip((found.hessian, found.gradient),
                            (expected.hessian, expected.gradient), strict=True):  # fmt: skip
            np.testing.assert_allclose(one[run], two, rtol=1e-9, atol=1e-9 * np.abs(two).max())


def test_an_epipolar_residual_is_the_distance_from_the_epipolar_line() -> None:
    """Side by side, u is free and a difference of 2 px in v is one of sqrt(2) px from each line."""
    lens = Lens.of("pinhole", fx=700.0, fy=700.0, cx=600.0, cy=200.0)
    block = PairBlock.epipolar(lens, lens, np.array([[650.0, 240.0]]), np.array([[610.0, 242.0]]))
    for length in (0.1, 0.5):
        T_lidar_b = gtsam.Pose3(gtsam.Rot3(), np.array([length, 0.0, 0.0]))
        # Sampson's distance is of first order in the ratio of 2 px to the focal length.
        residuals = block.residuals(gtsam.Pose3(), T_lidar_b)[0]
        assert np.abs(residuals[:, 0]) == pytest.approx([2.0 / np.sqrt(2.0)], rel=1e-5)


def test_without_a_baseline_there_is_no_epipolar_constraint() -> None:
    block = Features(LENSES["pinhole"], 20).block("epipolar")
    sums = block.sums(T_LIDAR_A, T_LIDAR_A.compose(gtsam.Pose3(gtsam.Rot3.Ry(0.1), np.zeros(3))))
    assert not sums.hessian.any() and not sums.gradient.any()


def test_a_ray_that_leaves_its_plane_gives_finite_numbers() -> None:
    """A turns by up to half a turn: rays pass the horizon of their planes."""
    block = Features(LENSES["pinhole"], 50).block("surface")
    for angle in np.linspace(0, np.pi, 50):
        sums = block.sums(T_LIDAR_A.retract(np.array([0, angle, 0, 0, 0, 0])), T_LIDAR_B)
        assert np.isfinite(sums.hessian).all() and np.isfinite(sums.gradient).all()
        assert np.isfinite(sums.cost)


BAD: dict[str, Callable[[Features], object]] = {
    "shape": lambda f: PairBlock.of_surfaces(f.lenses[1], f.rays_a, f.planes[:3], f.pixels_b),
    "nan": lambda f: PairBlock.of_surfaces(f.lenses[1], f.rays_a, f.planes * np.nan, f.pixels_b),
    "sigma": lambda f: f.block("surface").rescale(scale=1.0, sigma=0.0),
    "ray": lambda f: PairBlock.epipolar(*f.lenses, f.pixels_a * np.nan, f.pixels_b),
    "pixels": lambda f: PairBlock.epipolar(*f.lenses, f.pixels_a, f.pixels_b[:2]),
}


@pytest.mark.parametrize("make", BAD.values(), ids=BAD)
def test_wrong_blocks_are_refused(make: Callable[[Features], object]) -> None:
    with pytest.raises(ValueError, match=r"expected|finite|positive|no ray"):
        make(Features(LENSES["pinhole"], 10))
