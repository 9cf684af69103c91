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

from factors.block_arrays import RobustBlock
from factors.block_sums import BlockSums
from factors.compiled import compiled
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
        # Every loss has rho(s / sigma^2; delta) = rho(s; delta sigma) / sigma^2.
        packed = _accumulate(
            self.lens_b.kind, self.lens_b.packed, *_poses(T_lidar_a, T_lidar_b), self.rays_a,
            self.planes_lidar_per_m, self.pixels_b_px, loss_id(self.loss), self.scale * self.sigma,
            edges,
        )  # fmt: skip
        return _unpacked(packed / self.sigma**2)

    def residuals(
        self, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) residuals [px], not divided by sigma; (n,) whether B's lens can see the point."""
        residuals, projectable = _residuals(
            self.lens_b.kind, self.lens_b.packed, *_poses(T_lidar_a, T_lidar_b), self.rays_a,
            self.planes_lidar_per_m, self.pixels_b_px,
        )  # fmt: skip
        return residuals, projectable


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


def _poses(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, ...]:
    """R_lidar_a and A's centre; R_b_a and A's centre in B's frame."""
    (R_a, c_a), (R_b, c_b) = (
        (pose.rotation().matrix(), pose.translation()) for pose in (T_lidar_a, T_lidar_b)
    )
    parts = R_a, c_a, R_b.T @ R_a, R_b.T @ (c_a - c_b)
    return tuple(map(np.ascontiguousarray, parts))


@compiled()
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _predict(R_a, c_a, R_b_a, t, ray, plane, y, g):  # type: ignore[no-untyped-def]
    """Fill in y and g = R_a^T q; return w and k."""
    for i in range(3):
        g[i] = R_a[0, i] * plane[0] + R_a[1, i] * plane[1] + R_a[2, i] * plane[2]
    k = 1.0 - _dot(plane, c_a)
    if abs(k) < 1e-9:  # noqa: PLR2004 - A's centre is on the plane
        k = 1e-9
    w = _dot(g, ray) / k
    for i in range(3):
        y[i] = _dot(R_b_a[i], ray) + w * t[i]
    return w, k


@compiled()
def _fill_jacobian(R_b_a, t, ray, g, y, w, k, projection, jacobian):  # type: ignore[no-untyped-def]
    """(2, 12) derivatives of the pixel by both poses."""
    turn0 = (ray[1] * g[2] - ray[2] * g[1]) / k
    turn1 = (ray[2] * g[0] - ray[0] * g[2]) / k
    turn2 = (ray[0] * g[1] - ray[1] * g[0]) / k
    for row in range(2):
        d0, d1, d2 = projection[2 + 3 * row], projection[3 + 3 * row], projection[4 + 3 * row]
        e0 = d0 * R_b_a[0, 0] + d1 * R_b_a[1, 0] + d2 * R_b_a[2, 0]  # d y by A's axes
        e1 = d0 * R_b_a[0, 1] + d1 * R_b_a[1, 1] + d2 * R_b_a[2, 1]
        e2 = d0 * R_b_a[0, 2] + d1 * R_b_a[1, 2] + d2 * R_b_a[2, 2]
        along = d0 * t[0] + d1 * t[1] + d2 * t[2]
        j = jacobian[row]
        j[0] = ray[1] * e2 - ray[2] * e1 + along * turn0
        j[1] = ray[2] * e0 - ray[0] * e2 + along * turn1
        j[2] = ray[0] * e1 - ray[1] * e0 + along * turn2
        j[3] = w * (e0 + along * g[0] / k)
        j[4] = w * (e1 + along * g[1] / k)
        j[5] = w * (e2 + along * g[2] / k)
        j[6] = d1 * y[2] - d2 * y[1]
        j[7] = d2 * y[0] - d0 * y[2]
        j[8] = d0 * y[1] - d1 * y[0]
        j[9], j[10], j[11] = -w * d0, -w * d1, -w * d2


@compiled()
def _accumulate(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    kind, lens, R_a, c_a, R_b_a, t, rays, planes, pixels, loss, scale, edges
):
    """(segments, 91) sums over runs of features."""
    out = np.zeros((len(edges) - 1, 91))
    y, g, jacobian = np.empty(3), np.empty(3), np.empty((2, 12))
    for segment in range(len(edges) - 1):
        sums = out[segment]
        for n in range(edges[segment], edges[segment + 1]):
            w, k = _predict(R_a, c_a, R_b_a, t, rays[n], planes[n], y, g)
            projection = project_one(kind, lens, y[0], y[1], y[2])
            _fill_jacobian(R_b_a, t, rays[n], g, y, w, k, projection, jacobian)
            u = subtract_columns(kind, lens, projection[0], pixels[n, 0])
            v = projection[1] - pixels[n, 1]
            rho, psi = loss_and_weight(loss, scale, u * u + v * v)
            sums[90] += rho
            place = 0
            for i in range(12):
                a, b = psi * jacobian[0, i], psi * jacobian[1, i]
                sums[78 + i] += a * u + b * v
                for j in range(i, 12):
                    sums[place] += a * jacobian[0, j] + b * jacobian[1, j]
                    place += 1
    return out


@compiled()
def _residuals(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    kind, lens, R_a, c_a, R_b_a, t, rays, planes, pixels
):
    residuals, valid = np.empty((len(rays), 2)), np.empty(len(rays), np.bool_)
    y, g = np.empty(3), np.empty(3)
    for n in range(len(rays)):
        w, _ = _predict(R_a, c_a, R_b_a, t, rays[n], planes[n], y, g)
        projection = project_one(kind, lens, y[0], y[1], y[2])
        residuals[n, 0] = subtract_columns(kind, lens, projection[0], pixels[n, 0])
        residuals[n, 1] = projection[1] - pixels[n, 1]
        valid[n] = w > 0.0 and is_projectable(kind, lens, y[0] / w, y[1] / w, y[2] / w)
    return residuals, valid


_UPPER = np.triu_indices(12)


def _unpacked(sums: Array) -> BlockSums:
    """Split (f, 91) sums into H, b and c."""
    hessian = np.empty((len(sums), 12, 12))
    hessian[:, _UPPER[0], _UPPER[1]] = sums[:, :78]
    hessian[:, _UPPER[1], _UPPER[0]] = sums[:, :78]
    return BlockSums(hessian, sums[:, 78:90], sums[:, 90])
