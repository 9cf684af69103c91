"""Factors of co-visible features of two cameras, on ``T_lidar_a`` and ``T_lidar_b``.

A feature with the unit ray f in A lies on a plane q . p = 1 [1/m] that the LiDAR measured. With
X = T_lidar_camera = (R, c), its inverse range w from A, and w times its place in B's frame, are

    w = q . R_a f / k,   k = 1 - q . c_a,        y = R_b^T (R_a f + w (c_a - c_b)),

and the residual is pi_b(y) - u_b. The range follows from the pose of A, as that of the real feature
does: where A moves, its ray meets the surface in another point. Written with the inverse range, a
ray that no longer meets the plane passes smoothly through infinity.

A feature without depth gives an epipolar residual, on rays, so that any lens will do. For unit rays
f_a, f_b of one feature and the relative pose (R, t) = T_a_b, both rays and the baseline lie in one
plane where C(f_a, f_b) = f_a . (t x R f_b) = 0. The residual is C over its own standard deviation
for pixel errors of 1 px (Sampson's distance; here with the derivatives of the rays by the pixels,
F_a and F_b, instead of a linear lens):

    r = C / D,   D^2 = |C(F_a, f_b)|^2 + |C(f_a, F_b)|^2      [px].

It does not depend on the length of t, which epipolar geometry does not determine. Only the relative
pose enters: X exp(xi) gives T_a_b exp(delta), delta = xi_b - Ad(T_a_b^-1) xi_a.

All features of a block are one lossless factor, as of ``factors.block``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Self

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.arrays import BlockSums, RobustBlock, check_shape, contiguous
from factors.block import ProjectionBlock
from factors.columns import Columns
from factors.compiled import compiled
from factors.kernel import FAST, TILE, WIDTH, add_weighted, complete, weigh
from factors.lens import Lens, ray_spreads, unproject
from factors.lens_kernels import is_projectable, project_one
from factors.pose import lossless_factor

Array = NDArray[np.float64]

EPIPOLAR = -1  # in place of a kind of lens
_LEAST_K = 1e-9  # in place of less: A's centre is on the plane
_LEAST_SQUARE = 1e-300  # of D: less has no baseline, or both rays are along it


@dataclass(frozen=True, eq=False)
class PairBlock(RobustBlock):
    """Features of camera A, seen in camera B. Immutable. Built by one of its static methods.

    Attributes:
        kind: of B's lens; EPIPOLAR, where features have no surface.
        lens: parameters of B's.
        features: (n, 8) f, q and the pixel in B; of epipolar ones, (n, 18) f_a, F_a, f_b, F_b.
        scale: of the residual over sigma, at which the loss bends.
        sigma: what all residuals are divided by [px].

    Raises:
        ValueError: on a scale or sigma <= 0.
    """

    kind: int
    lens: Array
    features: Array
    scale: float = 4.0
    sigma: float = 1.0

    def __post_init__(self) -> None:
        self._check_scales()
        self.__dict__["features"] = contiguous(self.features)

    @staticmethod
    def of_surfaces(lens_b: Lens, rays_a: Array, planes: Array, pixels_b: Array) -> PairBlock:
        """Features with their surfaces.

        Args:
            lens_b: of camera B.
            rays_a: (n, 3) unit rays f in A's frame.
            planes: (n, 3) q in the LiDAR frame [1/m].
            pixels_b: (n, 2) the same features in B [px].

        Raises:
            ValueError: on wrong shapes, or values that are not finite.
        """
        n = len(rays_a)
        for name, array, width in (
            ("rays_a", rays_a, 3),
            ("planes", planes, 3),
            ("pixels_b", pixels_b, 2),
        ):
            check_shape(name, array, (n, width))
        return PairBlock(lens_b.kind, lens_b.packed, np.column_stack([rays_a, planes, pixels_b]))

    @staticmethod
    def epipolar(lens_a: Lens, lens_b: Lens, pixels_a: Array, pixels_b: Array) -> PairBlock:
        """Features without a surface.

        Args:
            lens_a: of the one camera.
            lens_b: of the other.
            pixels_a: (n, 2) features in the one image [px]; every pixel must have a ray.
            pixels_b: (n, 2) the same features in the other.

        Raises:
            ValueError: on wrong shapes, and pixels without a ray.
        """
        n, parts = len(pixels_a), []
        for name, lens, pixels in (("pixels_a", lens_a, pixels_a), ("pixels_b", lens_b, pixels_b)):
            check_shape(name, pixels, (n, 2))
            rays, valid = unproject(lens, pixels)
            if not valid.all():
                row = int(np.flatnonzero(~valid)[0])
                raise ValueError(f"{name}[{row}] has no ray: {pixels[row]}")
            parts += [rays, ray_spreads(lens, rays).transpose(0, 2, 1).reshape(n, 6)]
        return PairBlock(EPIPOLAR, lens_b.packed, np.hstack(parts))

    @property
    def axes(self) -> int:
        """Of a residual."""
        return 1 if self.kind == EPIPOLAR else 2

    def __len__(self) -> int:
        return len(self.features)

    def select(self, rows: NDArray[Any]) -> Self:
        """The block with only some features: a mask or an index array."""
        other = self._copy()
        other.__dict__["features"] = contiguous(self.features[rows])
        return other

    def sums(self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> BlockSums:
        """H (12, 12), b (12,) and c, in GTSAM's tangents of both poses, first A's."""
        poses = T_lidar_a.matrix()[None], T_lidar_b.matrix()[None]
        return self.run_sums(*poses, np.array([0, len(self)])).first()

    def run_sums(self, T_lidar_a: Array, T_lidar_b: Array, edges: NDArray[np.int64]) -> BlockSums:
        """H, b and c of each run ``edges[i]:edges[i + 1]`` of the features, stacked.

        At (r, 4, 4) poses of each run, or (1, 4, 4) of all.
        """
        none = np.empty((0, 2)), np.empty(0, np.bool_)
        return BlockSums.unpack(self._evaluate(T_lidar_a, T_lidar_b, edges, *none))

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point.

        Of epipolar ones the second is zero.
        """
        residuals, visible = np.empty((len(self), 2)), np.empty(len(self), np.bool_)
        poses = T_lidar_a.matrix()[None], T_lidar_b.matrix()[None]
        self._evaluate(*poses, np.array([0, len(self)]), residuals, visible)
        return residuals, visible

    def _evaluate(
        self, T_lidar_a: Array, T_lidar_b: Array, edges: NDArray[np.int64], *out: NDArray[Any]
    ) -> Array:
        """The sums of runs; or fill in the residuals of all features, and which are visible."""
        sums = np.zeros((len(edges) - 1, 1, 14, 13))
        _kernel(self.kind)(
            self.lens, contiguous(T_lidar_a), contiguous(T_lidar_b), self.features,
            float(self.scale), float(self.sigma), contiguous(edges), sums, *out,
        )  # fmt: skip
        return sums


def pair_block_factor(key_a: int, key_b: int, block: PairBlock) -> gtsam.CustomFactor:
    """All features as one factor on ``T_lidar_a`` and ``T_lidar_b``, equal to separate factors."""
    return lossless_factor([key_a, key_b], lambda *poses: (block.sums(*poses), None))


def placed_factor(
    keys: Sequence[int], block: ProjectionBlock | PairBlock, free: Columns | None = None
) -> gtsam.CustomFactor:
    """A block as one factor, with the cloud displaced, equal to its separate factors.

    Args:
        keys: of ``T_lidar_cloud``, ``T_lidar_camera`` of the camera or of both of a pair, and of
            the columns, a vector of k numbers. The block is at T_cloud_camera.
        block: correspondences of a camera, or features of a pair.
        free: k columns of the correspondences.
    """
    k = 0 if free is None else len(free)
    size = 6 * (len(keys) - (2 if k else 1)) + k

    def sums_at(cloud: gtsam.Pose3, *others: Any) -> tuple[BlockSums, Array]:
        cameras = [cloud.between(pose) for pose in (others[:-1] if k else others)]
        chain = np.eye(size, size + 6, 6)
        for number, pose in enumerate(cameras):
            chain[6 * number : 6 * number + 6, :6] = -pose.inverse().AdjointMap()
        if free is None or not isinstance(block, ProjectionBlock):
            return block.sums(*cameras), chain
        sums = block.summarize(cameras[0].inverse().matrix()[None], None, free, others[-1])
        return sums.first(), chain

    return lossless_factor(keys, sums_at, rows=size, columns=k)


@cache
def _kernel(kind: int) -> Any:
    @compiled(fastmath=FAST)
    def sum_runs(lens, T_a, T_b, features, scale, sigma, edges, sums, residuals, visible):  # type: ignore[no-untyped-def]
        """Fill in zeros (r, 1, 14, 13), see ``kernel``; or residuals, where there is room."""
        tile, psi = np.zeros((13, WIDTH)), np.empty(TILE)  # zero: a second, epipolar residual
        for run in range(len(sums)):
            T, found = T_a[run if len(T_a) > 1 else 0], sums[run, 0]
            M = _relative_pose(T, T_b[run if len(T_b) > 1 else 0])
            for start in range(edges[run], edges[run + 1], TILE):
                n = min(TILE, edges[run + 1] - start)
                for k in range(13 if kind == EPIPOLAR else 0):
                    for i in range(n, min(2 * n, TILE)):
                        tile[k, i] = 0.0
                for i in range(n):
                    seen = True
                    if kind == EPIPOLAR:
                        _fill_epipolar(M, features[start + i], tile, i)
                    else:
                        seen = _fill_surface(kind, lens, T, M, features[start + i], tile, i, n)
                    if len(residuals):
                        residuals[start + i, 0] = tile[12, i]
                        residuals[start + i, 1] = tile[12, n + i]
                        visible[start + i] = seen
                if len(residuals):
                    continue
                left = tile[12]
                found[13, 0] += weigh(scale * sigma, n, left, left[n:], psi)
                add_weighted(n, psi, tile, found)
            complete(sigma, found)

    return sum_runs


@compiled(inline="always")
def _fill_surface(kind, lens, T_a, M, feature, tile, i, n):  # type: ignore[no-untyped-def]
    """Fill in derivatives by A and B, and residuals; return whether B sees the point."""
    f0, f1, f2 = feature[0], feature[1], feature[2]
    q0, q1, q2 = feature[3], feature[4], feature[5]
    g0 = T_a[0, 0] * q0 + T_a[1, 0] * q1 + T_a[2, 0] * q2  # R_a^T q
    g1 = T_a[0, 1] * q0 + T_a[1, 1] * q1 + T_a[2, 1] * q2
    g2 = T_a[0, 2] * q0 + T_a[1, 2] * q1 + T_a[2, 2] * q2
    k = 1.0 - (q0 * T_a[0, 3] + q1 * T_a[1, 3] + q2 * T_a[2, 3])
    k = k if abs(k) >= _LEAST_K else _LEAST_K
    w = (g0 * f0 + g1 * f1 + g2 * f2) / k
    y0 = M[0, 0] * f0 + M[0, 1] * f1 + M[0, 2] * f2 + w * M[0, 3]
    y1 = M[1, 0] * f0 + M[1, 1] * f1 + M[1, 2] * f2 + w * M[1, 3]
    y2 = M[2, 0] * f0 + M[2, 1] * f1 + M[2, 2] * f2 + w * M[2, 3]
    u, v, ux, uy, uz, vx, vy, vz = project_one(kind, lens, y0, y1, y2)
    tile[12, i], tile[12, n + i] = u - feature[6], v - feature[7]
    for row in range(2):
        jx, jy, jz = (ux, uy, uz) if row == 0 else (vx, vy, vz)
        at = row * n + i
        along = (jx * M[0, 3] + jy * M[1, 3] + jz * M[2, 3]) / k
        a0 = jx * M[0, 0] + jy * M[1, 0] + jz * M[2, 0] + along * g0  # in A's axes
        a1 = jx * M[0, 1] + jy * M[1, 1] + jz * M[2, 1] + along * g1
        a2 = jx * M[0, 2] + jy * M[1, 2] + jz * M[2, 2] + along * g2
        tile[0, at], tile[1, at], tile[2, at] = _cross(f0, f1, f2, a0, a1, a2)
        tile[3, at], tile[4, at], tile[5, at] = w * a0, w * a1, w * a2
        tile[6, at], tile[7, at], tile[8, at] = _cross(jx, jy, jz, y0, y1, y2)
        tile[9, at], tile[10, at], tile[11, at] = -w * jx, -w * jy, -w * jz
    return w > 0.0 and is_projectable(kind, lens, y0 / w, y1 / w, y2 / w)


@compiled(part=True)
def _fill_epipolar(M, feature, tile, at):  # type: ignore[no-untyped-def]
    """Fill in derivatives by A and B, and the residual."""
    value, half, square = np.empty(7), np.zeros(6), 0.0
    for x, y in ((3, 9), (6, 9), (0, 12), (0, 15)):
        _fill_form(M, feature[x : x + 3], feature[y : y + 3], value)
        square += value[6] * value[6]
        for k in range(6):
            half[k] += value[k] * value[6]
    _fill_form(M, feature[0:3], feature[9:12], value)
    over = 1.0 / math.sqrt(square) if square > _LEAST_SQUARE else 0.0
    for k in range(6 if over > 0.0 else 0):
        value[k] -= value[6] / square * half[k]
    for k in range(7):
        tile[6 + k, at] = over * value[k]
    # By A: minus the derivative by B, a row, times Ad(T_b_a), T_b_a = M.
    v0, v1, v2 = tile[9, at], tile[10, at], tile[11, at]
    w0, w1, w2 = _cross(v0, v1, v2, M[0, 3], M[1, 3], M[2, 3])
    w0, w1, w2 = w0 + tile[6, at], w1 + tile[7, at], w2 + tile[8, at]
    for k in range(3):
        tile[k, at] = -(w0 * M[0, k] + w1 * M[1, k] + w2 * M[2, k])
        tile[3 + k, at] = -(v0 * M[0, k] + v1 * M[1, k] + v2 * M[2, k])


@compiled(part=True)
def _fill_form(M, x, y, out):  # type: ignore[no-untyped-def]
    """Derivatives of C(x, y) in the tangent of T_a_b, and last C itself.

    In B's axes, with T_b_a = M = (R^T, s): C = (s x R^T x) . y, since t = -R s.
    """
    a0 = M[0, 0] * x[0] + M[0, 1] * x[1] + M[0, 2] * x[2]
    a1 = M[1, 0] * x[0] + M[1, 1] * x[1] + M[1, 2] * x[2]
    a2 = M[2, 0] * x[0] + M[2, 1] * x[1] + M[2, 2] * x[2]
    b0, b1, b2 = _cross(M[0, 3], M[1, 3], M[2, 3], a0, a1, a2)  # R^T (x x t)
    out[0], out[1], out[2] = _cross(y[0], y[1], y[2], b0, b1, b2)
    out[3], out[4], out[5] = _cross(y[0], y[1], y[2], a0, a1, a2)
    out[6] = b0 * y[0] + b1 * y[1] + b2 * y[2]


@compiled(part=True, forceinline=True)
def _cross(a, b, c, x, y, z):  # type: ignore[no-untyped-def]
    return b * z - c * y, c * x - a * z, a * y - b * x


@compiled(part=True)
def _relative_pose(T_a, T_b):  # type: ignore[no-untyped-def]
    """(3, 4) T_b_a: R_b^T R_a and R_b^T (c_a - c_b)."""
    M = np.zeros((3, 4))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                M[i, j] += T_b[k, i] * T_a[k, j]
            M[i, 3] += T_b[k, i] * (T_a[k, 3] - T_b[k, 3])
    return M
