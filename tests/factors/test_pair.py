"""Factors of a pair of cameras: blocks are sums of the literal formulas, and their limits."""

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
    pair_block_factor,
    placed_factor,
    ray_spreads,
    unproject,
)
from tests.conftest import KANNALA, RADTAN5
from tests.draws.cameras import FORWARD
from tests.factors.blocks import K

Array = np.ndarray

A, B = 3, 8
LENSES = {
    "pinhole": (Lens.of("pinhole", **K), Lens.of("pinhole", **K, distortion=RADTAN5)),
    "fisheye": (Lens.of("fisheye", **K, distortion=KANNALA),) * 2,
    "mixed": (
        Lens.of("pinhole", **K, distortion=RADTAN5),
        Lens.of("fisheye", **K, distortion=KANNALA),
    ),
}

T_LIDAR_A = gtsam.Pose3(gtsam.Rot3(FORWARD.T), np.array([0.3, 0.1, -0.1]))
T_LIDAR_B = T_LIDAR_A.compose(
    gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.15, 0.01), np.array([0.5, 0.02, -0.05]))
)


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

    def residuals(self, kind: str, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> Array:
        """(n, 2) pi_b(T_b_a X_a) - u_b by plain matrices; X_a on the ray, where it meets the plane.

        Without a surface (n, 1): Sampson's, of C(x, y) = (x x t) . R y and its change by a pixel.
        """
        T_a_b = np.linalg.inv(T_lidar_a.matrix()) @ T_lidar_b.matrix()
        R, t = T_a_b[:3, :3], T_a_b[:3, 3]
        if kind == "epipolar":
            return self.sampson(lambda x, y: (np.cross(x, t) * (y @ R.T)).sum(axis=1))
        X_a = self.points_a
        if kind == "surface":
            outwards = self.rays_a @ T_lidar_a.rotation().matrix().T
            across = 1 - self.planes @ T_lidar_a.translation()
            X_a = self.rays_a * (across / (self.planes * outwards).sum(axis=1))[:, None]
        return np.asarray(self.lenses[1].project((X_a - t) @ R)[0] - self.pixels_b)

    def sampson(self, form: Callable[[Array, Array], Array]) -> Array:
        a, b = self.rays_a, unproject(self.lenses[1], self.pixels_b)[0]
        of_a, of_b = (ray_spreads(lens, x) for lens, x in zip(self.lenses, (a, b), strict=True))
        sides = [form(of_a[:, :, k], b) for k in (0, 1)] + [form(a, of_b[:, :, k]) for k in (0, 1)]
        return np.asarray(form(a, b) / np.linalg.norm(sides, axis=0))[:, None]

    def block(self, kind: str, scale: float = 2.0) -> PairBlock | ProjectionBlock:
        if kind == "epipolar":
            made = PairBlock.epipolar(*self.lenses, self.pixels_a, self.pixels_b)
            return replace(made, scale=scale)
        lens = self.lenses[1]
        if kind == "surface":
            made = PairBlock.of_surfaces(lens, self.rays_a, self.planes, self.pixels_b)
            return replace(made, scale=scale)
        return ProjectionBlock(lens, self.points_a, self.pixels_b, scale=scale)


KINDS = ("point", "surface", "epipolar")


def near_truth() -> list[gtsam.Pose3]:
    """Poses a degree and some centimetres off."""
    rng = np.random.default_rng(1)
    return [pose.retract(rng.normal(0, 0.02, 6)) for pose in (T_LIDAR_A, T_LIDAR_B)]


def derivatives(features: Features, kind: str, poses: list[gtsam.Pose3]) -> Array:
    """(n, axes, 12) by differences of fourth order: to 1e-9 px of some 700 px per radian."""

    def moved(twist: Array) -> Array:
        at = [pose.retract(part) for pose, part in zip(poses, np.split(twist, 2), strict=True)]
        return features.residuals(kind, *at)

    steps = 1e-3 * np.eye(12)
    columns = [8 * (moved(x) - moved(-x)) - (moved(2 * x) - moved(-2 * x)) for x in steps]
    return np.stack(columns, axis=2) / 12e-3


@pytest.mark.parametrize(
    ("lenses", "scale"), [("mixed", 2.0), ("mixed", np.inf), ("pinhole", 2.0), ("fisheye", 2.0)]
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_factor_is_the_robust_sum_of_the_literal_residuals(
    kind: str, scale: float, lenses: str
) -> None:
    features, poses = Features(LENSES[lenses], 60), near_truth()
    residuals, J = features.residuals(kind, *poses), derivatives(features, kind, poses)
    squares = np.square(residuals).sum(axis=1)
    weights = 1 / (1 + squares / scale**2)
    losses = squares if np.isinf(scale) else scale**2 * np.log1p(squares / scale**2)
    graph, values, order = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.Ordering()
    block = features.block(kind, scale)
    of_points = isinstance(block, ProjectionBlock)  # which are in the frame of A
    graph.add(placed_factor([A, B], block) if of_points else pair_block_factor(A, B, block))
    for key, pose in zip((A, B), poses, strict=True):
        values.insert(key, pose)
        order.push_back(key)
    hessian, gradient = graph.linearize(values).hessian(order)
    assert 2 * graph.error(values) == pytest.approx(losses.sum(), rel=1e-9)
    expected = np.einsum("nki,nkj,n->ij", J, J, weights)
    units = np.sqrt(np.maximum(np.diag(expected), 1e-300))
    np.testing.assert_allclose(
        hessian / np.outer(units, units), expected / np.outer(units, units), rtol=0, atol=1e-9
    )
    pulled = np.einsum("nki,nk,n->i", J, residuals, weights)
    limit = 1e-9 * np.sqrt(losses.sum())
    np.testing.assert_allclose(-gradient / units, pulled / units, rtol=0, atol=limit)
    if not of_points:
        found = block.residuals(*poses)[0][:, : residuals.shape[1]]
        np.testing.assert_allclose(found, residuals, rtol=0, atol=1e-9)


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
