"""Features of camera A on surfaces that the LiDAR measured, predicted in camera B.

A feature with the unit ray f in A lies on the plane q . p = 1 [1/m] of the LiDAR frame. With
X = T_lidar_camera = (R, c), its inverse range w from A, and w times its place in B's frame, are

    w = q . R_a f / k,   k = 1 - q . c_a,        y = R_b^T (R_a f + w (c_a - c_b)),

and the residual is pi_b(y) - u_b. Here the range follows from the pose of A, as that of the real
feature does: where A moves, its ray meets the surface in another point. With w held constant (then
f / w is the point X_a, fixed in A's frame), the residual is that of a point with a known depth, and
a wrong pose of A becomes a wrong relative pose. Written with the inverse range, a ray that no
longer meets the plane passes smoothly through infinity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, contiguous
from factors.block_sums import BlockSums
from factors.compiled import compiled
from factors.kernel_projection import FAST, TILE
from factors.lens import Lens
from factors.lens_kernels import is_projectable, project_one, subtract_columns
from factors.loss import loss_and_weight, loss_id

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
        sums = np.zeros((len(edges) - 1, 13, 13))
        _sum_runs(
            self.lens_b.kind, self.lens_b.packed, contiguous(T_lidar_a), contiguous(T_lidar_b),
            self.rays_a, self.planes_lidar_per_m, self.pixels_b_px, loss_id(self.loss),
            self.scale, self.sigma, contiguous(edges), sums,
        )  # fmt: skip
        return BlockSums(sums[:, :12, :12], sums[:, :12, 12], sums[:, 12, 12])

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point."""
        residuals, visible = np.empty((len(self), 2)), np.empty(len(self), np.bool_)
        _fill_residuals(
            self.lens_b.kind, self.lens_b.packed, contiguous(T_lidar_a.matrix()),
            contiguous(T_lidar_b.matrix()), self.rays_a, self.planes_lidar_per_m,
            self.pixels_b_px, residuals, visible,
        )  # fmt: skip
        return residuals, visible


_LEAST_K = 1e-9  # in place of less: A's centre is on the plane
_WIDTHS = {"rays_a": 3, "planes_lidar_per_m": 3, "pixels_b_px": 2}


@compiled(fastmath=FAST)
def _sum_runs(  # type: ignore[no-untyped-def]
    kind, lens, T_a, T_b, rays, planes, pixels, loss, scale, sigma, edges, sums
):
    """Fill (r, 13, 13): H, b in the last column, and c in the corner."""
    tile = np.empty((13, 2 * TILE + 8))  # rows of 4096 bytes would share cache lines
    for run in range(len(edges) - 1):
        T = T_a[run if len(T_a) > 1 else 0]
        M = _relative_pose(T, T_b[run if len(T_b) > 1 else 0])
        for start in range(edges[run], edges[run + 1], TILE):
            n = min(TILE, edges[run + 1] - start)
            for i in range(n):
                sums[run, 12, 12] += _linearize(
                    kind, lens, T, M, rays, planes, pixels, start + i, loss, scale, sigma, tile, i
                )
            for i in range(12):
                first = tile[i]
                for j in range(i, 13):
                    second, total = tile[j], 0.0
                    for k in range(2 * n):
                        total += first[k] * second[k]
                    sums[run, i, j] += total
        for i in range(12):
            for j in range(i):
                sums[run, i, j] = sums[run, j, i]


@compiled(part=True)
def _linearize(  # type: ignore[no-untyped-def]
    kind, lens, T_a, M, rays, planes, pixels, number, loss, scale, sigma, tile, column
):
    """Fill two columns with derivatives by A and B, and residuals, times the weight's root.

    The loss.
    """
    f0, f1, f2, at = rays[number, 0], rays[number, 1], rays[number, 2], 2 * column
    g0, g1, g2, k = _seen_from_a(T_a, planes, number)
    w = (g0 * f0 + g1 * f1 + g2 * f2) / k
    y0, y1, y2 = _place(M, f0, f1, f2, w)
    u, v, ux, uy, uz, vx, vy, vz = project_one(kind, lens, y0, y1, y2)
    ru = subtract_columns(kind, lens, u, pixels[number, 0]) / sigma
    rv = (v - pixels[number, 1]) / sigma
    value, weight = loss_and_weight(loss, scale, ru * ru + rv * rv)
    root = math.sqrt(weight)
    over = root / sigma
    tile[12, at], tile[12, at + 1] = root * ru, root * rv
    for row in range(2):
        jx, jy, jz = (ux, uy, uz) if row == 0 else (vx, vy, vz)
        jx, jy, jz, n = over * jx, over * jy, over * jz, at + row
        along = (jx * M[0, 3] + jy * M[1, 3] + jz * M[2, 3]) / k
        a0 = jx * M[0, 0] + jy * M[1, 0] + jz * M[2, 0] + along * g0  # in A's axes
        a1 = jx * M[0, 1] + jy * M[1, 1] + jz * M[2, 1] + along * g1
        a2 = jx * M[0, 2] + jy * M[1, 2] + jz * M[2, 2] + along * g2
        tile[0, n] = f1 * a2 - f2 * a1
        tile[1, n] = f2 * a0 - f0 * a2
        tile[2, n] = f0 * a1 - f1 * a0
        tile[3, n], tile[4, n], tile[5, n] = w * a0, w * a1, w * a2
        tile[6, n] = jy * y2 - jz * y1
        tile[7, n] = jz * y0 - jx * y2
        tile[8, n] = jx * y1 - jy * y0
        tile[9, n], tile[10, n], tile[11, n] = -w * jx, -w * jy, -w * jz
    return value


@compiled()
def _fill_residuals(kind, lens, T_a, T_b, rays, planes, pixels, out, visible):  # type: ignore[no-untyped-def]
    """Fill (n, 2) residuals [px], and (n,) whether B sees the point where A's ray meets it."""
    M = _relative_pose(T_a, T_b)
    for i in range(len(rays)):
        f0, f1, f2 = rays[i, 0], rays[i, 1], rays[i, 2]
        g0, g1, g2, k = _seen_from_a(T_a, planes, i)
        w = (g0 * f0 + g1 * f1 + g2 * f2) / k
        y0, y1, y2 = _place(M, f0, f1, f2, w)
        found = project_one(kind, lens, y0, y1, y2)
        out[i, 0] = subtract_columns(kind, lens, found[0], pixels[i, 0])
        out[i, 1] = found[1] - pixels[i, 1]
        visible[i] = w > 0.0 and is_projectable(kind, lens, y0 / w, y1 / w, y2 / w)


@compiled(part=True)
def _relative_pose(T_a, T_b):  # type: ignore[no-untyped-def]
    """(3, 4) R_b^T R_a and R_b^T (c_a - c_b)."""
    M = np.zeros((3, 4))
    for i in range(3):
        for k in range(3):
            for j in range(3):
                M[i, j] += T_b[k, i] * T_a[k, j]
            M[i, 3] += T_b[k, i] * (T_a[k, 3] - T_b[k, 3])
    return M


@compiled(part=True)
def _seen_from_a(T_a, planes, number):  # type: ignore[no-untyped-def]
    """A plane's g = R_a^T q, and k."""
    q0, q1, q2 = planes[number, 0], planes[number, 1], planes[number, 2]
    g0 = T_a[0, 0] * q0 + T_a[1, 0] * q1 + T_a[2, 0] * q2
    g1 = T_a[0, 1] * q0 + T_a[1, 1] * q1 + T_a[2, 1] * q2
    g2 = T_a[0, 2] * q0 + T_a[1, 2] * q1 + T_a[2, 2] * q2
    k = 1.0 - (q0 * T_a[0, 3] + q1 * T_a[1, 3] + q2 * T_a[2, 3])
    return g0, g1, g2, k if abs(k) >= _LEAST_K else _LEAST_K


@compiled(part=True)
def _place(M, f0, f1, f2, w):  # type: ignore[no-untyped-def]
    """The point y in B's frame."""
    return (
        M[0, 0] * f0 + M[0, 1] * f1 + M[0, 2] * f2 + w * M[0, 3],
        M[1, 0] * f0 + M[1, 1] * f1 + M[1, 2] * f2 + w * M[1, 3],
        M[2, 0] * f0 + M[2, 1] * f1 + M[2, 2] * f2 + w * M[2, 3],
    )
