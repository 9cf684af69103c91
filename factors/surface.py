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

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import RobustBlock, rotate_each
from factors.block_sums import BlockSums, sums_of_runs
from factors.lens import Lens
from factors.loss import loss_id, losses_and_weights

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
        run = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
        poses = [T if len(T) == 1 else T[run] for T in (T_lidar_a, T_lidar_b)]
        some = self if len(run) == len(self) else self.select(np.arange(edges[0], edges[-1]))
        return sums_of_runs(*some._linearize(*poses), edges)

    def _linearize(self, T_lidar_a: Array, T_lidar_b: Array) -> tuple[Array, Array]:
        """(2 n, 13) Jacobian and residuals, times the root of the loss' weight; (n,) losses.

        At (n, 4, 4) poses of each feature, or (1, 4, 4).
        """
        at = _Prediction.of(T_lidar_a, T_lidar_b, self.rays_a, self.planes_lidar_per_m)
        pixels, by_point = self.lens_b.project_with_jacobian(at.y)
        residuals = self.lens_b.subtract(pixels, self.pixels_b_px) / self.sigma
        squares = np.square(residuals).sum(axis=1)
        loss, weight = losses_and_weights(loss_id(self.loss), self.scale, squares)
        rows = np.concatenate([at.by_poses(by_point) / self.sigma, residuals[:, :, None]], axis=2)
        rows *= np.sqrt(weight)[:, None, None]
        return rows.reshape(-1, 13), loss

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point."""
        T_a, T_b = T_lidar_a.matrix()[None], T_lidar_b.matrix()[None]
        at = _Prediction.of(T_a, T_b, self.rays_a, self.planes_lidar_per_m)
        pixels, _ = self.lens_b.project(at.y)
        with np.errstate(divide="ignore", invalid="ignore"):  # a ray that meets no surface
            _, projectable = self.lens_b.project(at.y / at.w[:, None])
        return self.lens_b.subtract(pixels, self.pixels_b_px), projectable & (at.w > 0.0)


_LEAST_K = 1e-9  # in place of less: A's centre is on the plane
_WIDTHS = {"rays_a": 3, "planes_lidar_per_m": 3, "pixels_b_px": 2}


@dataclass(frozen=True, eq=False)
class _Prediction:
    """Features of A in B's frame: see the module. With g = R_a^T q.

    Attributes:
        rays_a, y, g, t: (n, 3) f, y, g and R_b^T (c_a - c_b); t also (1, 3).
        R_b_a: (n, 3, 3) or (1, 3, 3).
        w, k: (n,).
    """

    rays_a: Array
    y: Array
    g: Array
    t: Array
    R_b_a: Array
    w: Array
    k: Array

    @staticmethod
    def of(T_lidar_a: Array, T_lidar_b: Array, rays_a: Array, planes: Array) -> _Prediction:
        """At (n, 4, 4) poses of each feature, or (1, 4, 4)."""
        R_a, c_a, to_b = T_lidar_a[:, :3, :3], T_lidar_a[:, :3, 3], _transpose(T_lidar_b)
        g = rotate_each(_transpose(T_lidar_a), planes)
        k = 1.0 - (planes * c_a).sum(axis=1)
        k = np.where(np.abs(k) < _LEAST_K, _LEAST_K, k)
        w = (g * rays_a).sum(axis=1) / k
        R_b_a, t = to_b @ R_a, rotate_each(to_b, c_a - T_lidar_b[:, :3, 3])
        return _Prediction(rays_a, rotate_each(R_b_a, rays_a) + w[:, None] * t, g, t, R_b_a, w, k)

    def by_poses(self, by_point: Array) -> Array:
        """(n, 2, 12) derivatives of pixels by both poses, from (n, 2, 3) by y."""
        rays, w = self.rays_a[:, None], self.w[:, None, None]
        g = (self.g / self.k[:, None])[:, None]
        of_axes = by_point @ self.R_b_a  # of A
        along = by_point @ self.t[:, :, None]
        turn = np.cross(rays, of_axes) + along * np.cross(rays, g)
        parts = turn, w * (of_axes + along * g), np.cross(by_point, self.y[:, None]), -w * by_point
        return np.concatenate(parts, axis=2)


def _transpose(T: Array) -> Array:
    return T[:, :3, :3].transpose(0, 2, 1)
