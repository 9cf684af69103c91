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
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, contiguous
from factors.block_sums import BlockSums
from factors.compiled import compiled
from factors.lens import Lens
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
        lengths = np.diff(edges)
        seen = _Seen.by(self, _of_rows(T_lidar_a, lengths), _of_rows(T_lidar_b, lengths))
        residual, by_poses = seen.residuals_and_jacobians()
        # Every loss has rho(s / sigma^2; delta) = rho(s; delta sigma) / sigma^2.
        sums = _accumulate(
            by_poses, residual, loss_id(self.loss), self.scale * self.sigma, contiguous(edges)
        )
        sums /= self.sigma**2
        return BlockSums(sums[:, :12], sums[:, 12], sums[:, 13, 0])

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point."""
        seen = _Seen.by(self, T_lidar_a.matrix()[None], T_lidar_b.matrix()[None])
        ahead = seen.inverse_range > 0
        points = seen.point / np.where(ahead, seen.inverse_range, 1.0)[:, None]
        return seen.residuals_and_jacobians()[0].T, ahead & self.lens_b.sees(points)


_TILE = 64  # features whose derivatives are held at once, in the first-level cache
_ON_PLANE = 1e-9  # least 1 - q . c_a: below, A's centre is on the plane
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


def _of_rows(poses: Array, lengths: NDArray[np.int64]) -> Array:
    """(n, 4, 4) the pose of each row from those of the runs, or (1, 4, 4) of all."""
    return poses if len(poses) == 1 else poses.repeat(lengths, axis=0)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Features with their predictions in camera B; see the module, whose letters are in brackets.

    Attributes:
        block: the features.
        R_b_a, t: (m, 3, 3) and (m, 3), m is n or 1: of A in B's frame.
        normal: (n, 3) R_a^T q / k [g / k].
        inverse_range: (n,) [w].
        point: (n, 3) [y].
    """

    block: SurfaceBlock
    R_b_a: Array
    t: Array
    normal: Array
    inverse_range: Array
    point: Array

    @staticmethod
    def by(block: SurfaceBlock, T_lidar_a: Array, T_lidar_b: Array) -> _Seen:
        """At (m, 4, 4) poses, m is n or 1."""
        (R_a, c_a), (R_b, c_b) = ((T[:, :3, :3], T[:, :3, 3]) for T in (T_lidar_a, T_lidar_b))
        rays, planes = block.rays_a, block.planes_lidar_per_m
        k = 1.0 - (planes * c_a).sum(axis=1)
        k = np.where(np.abs(k) < _ON_PLANE, _ON_PLANE, k)
        normal = (planes[:, None] @ R_a)[:, 0] / k[:, None]
        w = (normal * rays).sum(axis=1)
        back = R_b.transpose(0, 2, 1)
        R_b_a, t = back @ R_a, (back @ (c_a - c_b)[:, :, None])[:, :, 0]
        point = (R_b_a @ rays[:, :, None])[:, :, 0] + w[:, None] * t
        return _Seen(block, R_b_a, t, normal, w, point)

    def residuals_and_jacobians(self) -> tuple[Array, Array]:
        """(2, n) residuals [px]; (2, 12, n) derivatives by both poses, first A's."""
        lens, ray = self.block.lens_b, self.block.rays_a[:, None]
        pixels, d = lens.project_with_jacobian(self.point)
        w = self.inverse_range[:, None, None]
        by_a = d @ self.R_b_a
        by_range = (d @ self.t[:, :, None]) * self.normal[:, None]
        by_a_and_range = by_a + by_range
        parts = (
            np.cross(ray, by_a_and_range), w * by_a_and_range,
            np.cross(d, self.point[:, None]), -w * d,
        )  # fmt: skip
        residuals = lens.subtract(pixels, self.block.pixels_b_px)
        return contiguous(residuals.T), contiguous(np.concatenate(parts, axis=2).transpose(1, 2, 0))


@compiled(fastmath=FAST)
def _accumulate(jacobian, residual, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(runs, 14, 12) sums over runs of features: H, b, and c first in the last row."""
    out = np.zeros((len(edges) - 1, 14, 12))
    psi, weighted = np.empty(_TILE), np.empty((2, _TILE))
    wu, wv = weighted[0], weighted[1]
    for run in range(len(edges) - 1):
        sums = out[run]
        for start in range(edges[run], edges[run + 1], _TILE):
            count = min(_TILE, edges[run + 1] - start)
            u, v = residual[0, start:], residual[1, start:]
            for n in range(count):
                rho, psi[n] = loss_and_weight(loss, scale, u[n] * u[n] + v[n] * v[n])
                sums[13, 0] += rho
            for i in range(12):
                ju, jv, slope = jacobian[0, i, start:], jacobian[1, i, start:], 0.0
                for n in range(count):
                    wu[n], wv[n] = psi[n] * ju[n], psi[n] * jv[n]
                    slope += wu[n] * u[n] + wv[n] * v[n]
                sums[12, i] += slope
                for j in range(i, 12):
                    ku, kv, total = jacobian[0, j, start:], jacobian[1, j, start:], 0.0
                    for n in range(count):
                        total += wu[n] * ku[n] + wv[n] * kv[n]
                    sums[i, j] += total
        for i in range(12):
            for j in range(i):
                sums[i, j] = sums[j, i]
    return out
