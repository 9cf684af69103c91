"""Features of camera A on surfaces that the LiDAR measured, predicted in camera B.

A feature with the unit ray f in A lies on the plane q . p = 1 [1/m] of the LiDAR frame. With
X = T_lidar_camera = (R, c), its inverse range w from A, and w times its place in B's frame, are

    w = q . R_a f / k,   k = 1 - q . c_a,        y = R_b^T (R_a f + w (c_a - c_b)),

and the residual is pi_b(y) - u_b. Here the range follows from the pose of A, as that of the real
feature does: where A moves, its ray meets the surface in another point. With w held constant (then
f / w is the point X_a, fixed in A's frame), the residual is that of ``pair_projection_factor``, and
a wrong pose of A becomes a wrong relative pose. Written with the inverse range, a ray that no
longer meets the plane passes smoothly through infinity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, contiguous
from factors.block_sums import BlockSums
from factors.compiled import compiled
from factors.lens import Lens
from factors.lens_kernels import is_projectable, project_one, subtract_columns
from factors.loss import loss_and_weight, loss_id
from factors.tile import FAST

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SurfaceBlock(RobustBlock):
    """Features of camera A with their surfaces, and their pixels in camera B. Immutable.

    Attributes:
        lens_b: of camera B.
        rays_a: (n, 3) unit rays f in A's frame.
        planes_lidar_per_m: (n, 3) q in the LiDAR frame.
        pixels_b_px: (n, 2) the same features in B.
        loss: name of the robust loss.
        scale: of the residual over sigma, at which the loss bends.
        sigma: what all residuals are divided by [px].

    Raises:
        ValueError: on wrong shapes, values that are not finite, an unknown loss, a scale or sigma
            <= 0.
    """

    lens_b: Lens
    rays_a: Array
    planes_lidar_per_m: Array
    pixels_b_px: Array
    loss: str = "cauchy"
    scale: float = 4.0
    sigma: float = 1.0

    def __post_init__(self) -> None:
        n = len(self.rays_a)
        loss_id(self.loss)
        self._check_scale()
        for name, width in _WIDTHS.items():
            array = getattr(self, name)
            if array.shape != (n, width) or not np.isfinite(array).all():
                raise ValueError(
                    f"{name}: expected {(n, width)} finite values, found {array.shape}"
                )
            self._replace(**{name: np.ascontiguousarray(array, dtype=np.float64)})

    def __len__(self) -> int:
        return len(self.rays_a)

    def select(self, rows: NDArray[Any]) -> SurfaceBlock:
        """The block with only some features: a mask or an index array."""
        other = self._copy()
        other._replace(**{name: getattr(self, name)[rows] for name in _WIDTHS})
        return other

    def sums(self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> BlockSums:
        """H (12, 12), b (12,) and c, in GTSAM's tangents of both poses, first A's."""
        sums = self.frame_sums(T_lidar_a, T_lidar_b, np.array([0, len(self)]))
        return BlockSums(sums.hessian[0], sums.gradient[0], sums.cost[0])

    def frame_sums(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3, edges: NDArray[np.int64]
    ) -> BlockSums:
        """H, b and c of each run ``edges[i]:edges[i + 1]`` of the features, stacked."""
        return self.run_sums(T_lidar_a.matrix()[None], T_lidar_b.matrix()[None], edges)

    def run_sums(self, T_lidar_a: Array, T_lidar_b: Array, edges: NDArray[np.int64]) -> BlockSums:
        """As :meth:`frame_sums`, with (r, 4, 4) poses of each run, or (1, 4, 4) of all."""
        # Every loss has rho(s / sigma^2; delta) = rho(s; delta sigma) / sigma^2.
        sums = _accumulate(self.lens_b.kind)(
            self.lens_b.packed, contiguous(T_lidar_a), contiguous(T_lidar_b),
            self.rays_a, self.planes_lidar_per_m, self.pixels_b_px, loss_id(self.loss),
            self.scale * self.sigma, edges,
        )  # fmt: skip
        sums /= self.sigma**2
        return BlockSums(sums[:, :12], sums[:, 12], sums[:, 13, 0])

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point."""
        residuals, projectable = _residuals(self.lens_b.kind)(
            self.lens_b.packed, contiguous(T_lidar_a.matrix()),
            contiguous(T_lidar_b.matrix()), self.rays_a, self.planes_lidar_per_m, self.pixels_b_px,
        )  # fmt: skip
        return residuals, projectable


_TILE = 64  # features whose derivatives are held at once, in the first-level cache
_WIDTHS = {"rays_a": 3, "planes_lidar_per_m": 3, "pixels_b_px": 2}


def surface_residual(
    poses: tuple[gtsam.Pose3, gtsam.Pose3],
    lens_b: Lens,
    ray_a: Array,
    plane_lidar_per_m: Array,
    pixel_b_px: Array,
) -> tuple[Array, Array]:
    """Residual of one feature and its derivative, in numpy: the reference.

    Args:
        poses: ``T_lidar_a`` and ``T_lidar_b``.
        lens_b: of camera B.
        ray_a: (3,) f.
        plane_lidar_per_m: (3,) q.
        pixel_b_px: (2,) u_b.

    Returns:
        (2,) residual [px]; (2, 12) Jacobian in GTSAM's tangents of both poses, first A's.
    """
    (R_a, c_a), (R_b, c_b) = ((pose.rotation().matrix(), pose.translation()) for pose in poses)
    g, k = R_a.T @ plane_lidar_per_m, 1.0 - plane_lidar_per_m @ c_a
    w = g @ ray_a / k
    R_b_a, t = R_b.T @ R_a, R_b.T @ (c_a - c_b)
    y = R_b_a @ ray_a + w * t
    by_poses = np.hstack(
        [
            -R_b_a @ _skew(ray_a) + np.outer(t, np.cross(ray_a, g)) / k,
            w * R_b_a + w * np.outer(t, g) / k,
            _skew(y),
            -w * np.eye(3),
        ]
    )
    pixel, by_point = lens_b.project_with_jacobian(y)
    return lens_b.subtract(pixel, pixel_b_px)[0], by_point[0] @ by_poses


def _skew(v: Array) -> Array:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@compiled(inline="always")
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled(inline="always")
def _fill_relative(T_a, T_b, R_b_a, t):  # type: ignore[no-untyped-def]
    """R_b_a and A's centre in B's frame, from T_lidar_a and T_lidar_b."""
    for i in range(3):
        t[i] = 0.0
        for k in range(3):
            t[i] += T_b[k, i] * (T_a[k, 3] - T_b[k, 3])
        for j in range(3):
            R_b_a[i, j] = T_b[0, i] * T_a[0, j] + T_b[1, i] * T_a[1, j] + T_b[2, i] * T_a[2, j]


@compiled(inline="always")
def _predict(T_a, R_b_a, t, ray, plane, y, g):  # type: ignore[no-untyped-def]
    """Fill in y and g = R_a^T q; return w and k."""
    for i in range(3):
        g[i] = T_a[0, i] * plane[0] + T_a[1, i] * plane[1] + T_a[2, i] * plane[2]
    k = 1.0 - (plane[0] * T_a[0, 3] + plane[1] * T_a[1, 3] + plane[2] * T_a[2, 3])
    if abs(k) < 1e-9:  # noqa: PLR2004 - A's centre is on the plane
        k = 1e-9
    w = _dot(g, ray) / k
    for i in range(3):
        y[i] = _dot(R_b_a[i], ray) + w * t[i]
    return w, k


@compiled(inline="always")
def _fill_jacobian(R_b_a, t, ray, g, y, w, k, projection, jacobian, n):  # type: ignore[no-untyped-def]
    """Derivatives of a pixel by both poses, into column n of (2, 12, TILE)."""
    g0, g1, g2 = g[0] / k, g[1] / k, g[2] / k
    turn0 = ray[1] * g2 - ray[2] * g1
    turn1 = ray[2] * g0 - ray[0] * g2
    turn2 = ray[0] * g1 - ray[1] * g0
    for row in range(2):
        d0, d1, d2 = projection[2 + 3 * row], projection[3 + 3 * row], projection[4 + 3 * row]
        e0 = d0 * R_b_a[0, 0] + d1 * R_b_a[1, 0] + d2 * R_b_a[2, 0]  # d y by A's axes
        e1 = d0 * R_b_a[0, 1] + d1 * R_b_a[1, 1] + d2 * R_b_a[2, 1]
        e2 = d0 * R_b_a[0, 2] + d1 * R_b_a[1, 2] + d2 * R_b_a[2, 2]
        along = d0 * t[0] + d1 * t[1] + d2 * t[2]
        j = jacobian[row]
        j[0, n] = ray[1] * e2 - ray[2] * e1 + along * turn0
        j[1, n] = ray[2] * e0 - ray[0] * e2 + along * turn1
        j[2, n] = ray[0] * e1 - ray[1] * e0 + along * turn2
        j[3, n] = w * (e0 + along * g0)
        j[4, n] = w * (e1 + along * g1)
        j[5, n] = w * (e2 + along * g2)
        j[6, n] = d1 * y[2] - d2 * y[1]
        j[7, n] = d2 * y[0] - d0 * y[2]
        j[8, n] = d0 * y[1] - d1 * y[0]
        j[9, n], j[10, n], j[11, n] = -w * d0, -w * d1, -w * d2


@compiled(fastmath=FAST)
def _add_products(jacobian, residual, psi, count, weighted, sums):  # type: ignore[no-untyped-def]
    """Add J^T psi J and J^T psi r of a tile to (14, 12) sums, the upper triangle alone."""
    for i in range(12):
        ju, jv, wu, wv = jacobian[0, i], jacobian[1, i], weighted[0], weighted[1]
        slope = 0.0
        for n in range(count):
            wu[n], wv[n] = psi[n] * ju[n], psi[n] * jv[n]
            slope += wu[n] * residual[0, n] + wv[n] * residual[1, n]
        sums[12, i] += slope
        for j in range(i, 12):
            ku, kv, total = jacobian[0, j], jacobian[1, j], 0.0
            for n in range(count):
                total += wu[n] * ku[n] + wv[n] * kv[n]
            sums[i, j] += total


@cache
def _accumulate(kind: int) -> Any:
    @compiled()
    def run(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
        lens, T_lidar_a, T_lidar_b, rays, planes, pixels, loss, scale, edges
    ):
        """(runs, 14, 12) sums over runs of features: H, b, and c first in the last row."""
        out = np.zeros((len(edges) - 1, 14, 12))
        y, g, R_b_a, t = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
        jacobian, residual = np.empty((2, 12, _TILE)), np.empty((2, _TILE))
        psi, weighted = np.empty(_TILE), np.empty((2, _TILE))
        for run in range(len(edges) - 1):
            T_a = T_lidar_a[min(np.int64(run), len(T_lidar_a) - 1)]
            T_b = T_lidar_b[min(np.int64(run), len(T_lidar_b) - 1)]
            _fill_relative(T_a, T_b, R_b_a, t)
            sums = out[run]
            for start in range(edges[run], edges[run + 1], _TILE):
                count = min(_TILE, edges[run + 1] - start)
                for n in range(count):
                    row = start + n
                    w, k = _predict(T_a, R_b_a, t, rays[row], planes[row], y, g)
                    projection = project_one(kind, lens, y[0], y[1], y[2])
                    _fill_jacobian(R_b_a, t, rays[row], g, y, w, k, projection, jacobian, n)
                    u = subtract_columns(kind, lens, projection[0], pixels[row, 0])
                    v = projection[1] - pixels[row, 1]
                    rho, psi[n] = loss_and_weight(loss, scale, u * u + v * v)
                    residual[0, n], residual[1, n] = u, v
                    sums[13, 0] += rho
                _add_products(jacobian, residual, psi, count, weighted, sums)
            for i in range(12):
                for j in range(i):
                    sums[i, j] = sums[j, i]
        return out

    return run


@cache
def _residuals(kind: int) -> Any:
    @compiled()
    def run(lens, T_a, T_b, rays, planes, pixels):  # type: ignore[no-untyped-def]
        residuals, valid = np.empty((len(rays), 2)), np.empty(len(rays), np.bool_)
        y, g, R_b_a, t = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
        _fill_relative(T_a, T_b, R_b_a, t)
        for n in range(len(rays)):
            w, _ = _predict(T_a, R_b_a, t, rays[n], planes[n], y, g)
            projection = project_one(kind, lens, y[0], y[1], y[2])
            residuals[n, 0] = subtract_columns(kind, lens, projection[0], pixels[n, 0])
            residuals[n, 1] = projection[1] - pixels[n, 1]
            valid[n] = w > 0.0 and is_projectable(kind, lens, y[0] / w, y[1] / w, y[2] / w)
        return residuals, valid

    return run
