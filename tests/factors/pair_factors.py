"""Single features of two cameras as GTSAM factors, in numpy: the references of the blocks."""

import math

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import Lens, pair_chain, projection_residual, ray_spreads, robust_noise, unproject
from factors.pair import factor_on_two_poses

Array = NDArray[np.float64]


def pair_projection_factor(
    key_a: int,
    key_b: int,
    lens_b: Lens,
    point_a_m: ArrayLike,
    pixel_b_px: ArrayLike,
    *,
    sqrt_information: ArrayLike | None = None,
    loss: str = "cauchy",
    scale: float = 4.0,
) -> gtsam.CustomFactor:
    """One feature with depth: residual ``pi_b(T_b T_a^-1 X_a) - u_b``. The reference of the block.

    Args:
        key_a: the variable ``T_lidar_a``.
        key_b: the variable ``T_lidar_b``.
        lens_b: of camera B.
        point_a_m: (3,) X_a in A's frame.
        pixel_b_px: (2,) u_b.
        sqrt_information: (2, 2) upper triangular whitening matrix [1/px]; identity if None.
        loss: name of the robust loss.
        scale: whitened residual norm at which the loss bends.
    """
    point = np.asarray(point_a_m, dtype=np.float64)
    pixel = np.asarray(pixel_b_px, dtype=np.float64)
    whitening = np.eye(2) if sqrt_information is None else np.asarray(sqrt_information)

    def residual(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
        T_a_b = T_lidar_a.between(T_lidar_b)
        error, jacobian = projection_residual(lens_b, T_a_b, point, pixel)
        return error, jacobian @ pair_chain(T_lidar_a, T_lidar_b)

    base = gtsam.noiseModel.Gaussian.SqrtInformation(whitening)
    noise = robust_noise(base, loss=loss, scale=scale)
    return factor_on_two_poses(noise, key_a, key_b, residual)


def surface_factor(
    key_a: int,
    key_b: int,
    lens_b: Lens,
    ray_a: ArrayLike,
    plane_lidar_per_m: ArrayLike,
    pixel_b_px: ArrayLike,
    *,
    loss: str = "cauchy",
    scale: float = 4.0,
) -> gtsam.CustomFactor:
    """One feature on a surface of the LiDAR. The reference of ``SurfaceBlock``.

    Args:
        key_a: the variable ``T_lidar_a``.
        key_b: the variable ``T_lidar_b``.
        lens_b: of camera B.
        ray_a: (3,) the feature's unit ray in A's frame.
        plane_lidar_per_m: (3,) q, with q . p = 1 for points p of the surface in the LiDAR frame.
        pixel_b_px: (2,) the feature in B.
        loss: name of the robust loss.
        scale: residual norm [px] at which the loss bends.
    """
    ray, plane, pixel = (
        np.asarray(value, dtype=np.float64) for value in (ray_a, plane_lidar_per_m, pixel_b_px)
    )

    def residual(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
        return surface_residual((T_lidar_a, T_lidar_b), lens_b, ray, plane, pixel)

    noise = robust_noise(gtsam.noiseModel.Unit.Create(2), loss=loss, scale=scale)
    return factor_on_two_poses(noise, key_a, key_b, residual)


def epipolar_factor(
    key_a: int,
    key_b: int,
    lenses: tuple[Lens, Lens],
    pixels_px: tuple[ArrayLike, ArrayLike],
    *,
    loss: str = "cauchy",
    scale: float = 4.0,
) -> gtsam.CustomFactor:
    """One feature without depth: Sampson's residual [px]. The reference of ``EpipolarBlock``.

    Args:
        key_a: the variable ``T_lidar_a``.
        key_b: the variable ``T_lidar_b``.
        lenses: of A and of B.
        pixels_px: (2,) the feature in A and in B.
        loss: name of the robust loss.
        scale: residual [px] at which the loss bends.
    """
    pixel_a, pixel_b = (np.asarray(pixel, dtype=np.float64) for pixel in pixels_px)

    def residual(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> tuple[Array, Array]:
        T_a_b = T_lidar_a.between(T_lidar_b)
        error, jacobian = epipolar_residual(T_a_b, lenses, (pixel_a, pixel_b))
        return np.array([error]), jacobian[None] @ pair_chain(T_lidar_a, T_lidar_b)

    noise = robust_noise(gtsam.noiseModel.Unit.Create(1), loss=loss, scale=scale)
    return factor_on_two_poses(noise, key_a, key_b, residual)


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


def epipolar_residual(
    T_a_b: gtsam.Pose3, lenses: tuple[Lens, Lens], pixels_px: tuple[Array, Array]
) -> tuple[float, Array]:
    """Sampson's residual of one feature and its derivative, in numpy: the reference.

    Args:
        T_a_b: maps coordinates in b to coordinates in a.
        lenses: of a and of b.
        pixels_px: (2,) the feature in a and in b.

    Returns:
        The residual [px]; (6,) its Jacobian in GTSAM's tangent of ``T_a_b``.
    """
    (ray_a, spread_a), (ray_b, spread_b) = (
        (ray := unproject(lens, pixel)[0], ray_spreads(lens, ray)[0])
        for lens, pixel in zip(lenses, pixels_px, strict=True)
    )
    R, t = T_a_b.rotation().matrix(), T_a_b.translation()

    def form(x: Array, y: Array) -> tuple[float, Array]:
        """C(x, y) and its derivative: d(R y) = R (omega x y), d t = R v."""
        turned, normal = R @ y, np.cross(x, t)
        by_rotation, by_translation = np.cross(y, R.T @ normal), R.T @ np.cross(turned, x)
        return float(normal @ turned), np.concatenate([by_rotation, by_translation])

    value, derivative = form(ray_a[0], ray_b[0])
    sides = [form(side, ray_b[0]) for side in spread_a.T]
    sides += [form(ray_a[0], side) for side in spread_b.T]
    square = sum(c * c for c, _ in sides)
    half_of_square = np.sum([c * d for c, d in sides], axis=0)
    over = 1.0 / math.sqrt(square)
    return value * over, over * (derivative - value / square * half_of_square)
