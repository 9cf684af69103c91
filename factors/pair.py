"""Factors of co-visible features of two cameras, on ``T_lidar_a`` and ``T_lidar_b``.

A feature at u_a whose place X_a in A's frame is known (its depth comes from the LiDAR) is predicted
in B at pi_b(T_b T_a^-1 X_a), with T = T_camera_lidar. Only the relative pose enters:
T_a_b = T_a T_b^-1 is "the pose of camera B in the frame of the points", so a block of such features
is a :class:`ProjectionBlock` with points in A's frame, at T_a_b instead of T_lidar_camera; and its
sums H, b, c are those in the tangent of T_a_b. With X = T_lidar_camera,

    T_a_b = X_a^-1 X_b,    X exp(xi) gives    T_a_b exp(delta),   delta = xi_b - Ad(T_a_b^-1) xi_a,

so the block's square root factor (7 rows), times [-Ad(T_a_b^-1), I], is lossless on both poses.
A feature without depth gives an epipolar residual (``factors.epipolar``) by the same chain rule.
Where the range follows the pose of A (``factors.surface``), both poses enter, and the block's
square root has 13 rows.
"""

from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block import ProjectionBlock
from factors.block_arrays import to_runs
from factors.block_sums import BlockSums, square_root
from factors.custom import custom_factor
from factors.epipolar import EpipolarBlock
from factors.surface import SurfaceBlock

Array = NDArray[np.float64]


PairBlock = ProjectionBlock | EpipolarBlock | SurfaceBlock
"""Features of camera A, seen in camera B; a ``ProjectionBlock`` has points in A's frame, and the
lens and pixels of B."""


def pair_block_factor(key_a: int, key_b: int, block: PairBlock) -> gtsam.CustomFactor:
    """All features of a block as one factor on two poses, equal to its separate factors.

    The error and Jacobian of the last poses are kept, as in ``factors.block.block_factor``.

    Args:
        key_a: the variable ``T_lidar_a``.
        key_b: the variable ``T_lidar_b``.
        block: of features of camera A, seen in camera B.
    """
    last: tuple[bytes, tuple[Array, Array]] | None = None

    def residual(*poses: gtsam.Pose3) -> tuple[Array, Array]:
        nonlocal last
        place, found = b"".join(pose.matrix().tobytes() for pose in poses), last
        if found is None or found[0] != place:
            last = found = (place, _error_and_jacobian(block, *poses))
        return found[1]

    rows = 13 if isinstance(block, SurfaceBlock) else 7
    return factor_on_two_poses(gtsam.noiseModel.Unit.Create(rows), key_a, key_b, residual)


def placed_pair_factor(
    key_cloud: int, key_a: int, key_b: int, block: PairBlock
) -> gtsam.CustomFactor:
    """As :func:`pair_block_factor`, with the cloud displaced: on ``T_lidar_cloud`` and both poses.

    The block's poses are T_cloud_a = T_lidar_cloud^-1 T_lidar_a, and T_cloud_b likewise.

    Args:
        key_cloud: the variable ``T_lidar_cloud``.
        key_a: the variable ``T_lidar_a``.
        key_b: the variable ``T_lidar_b``.
        block: of features of camera A, seen in camera B.
    """

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        cloud, *cameras = (values.atPose3(key) for key in (key_cloud, key_a, key_b))
        found, jacobian = _error_and_jacobian(block, *(cloud.between(pose) for pose in cameras))
        chain = np.vstack([-pose.between(cloud).AdjointMap() for pose in cameras])
        return found, [jacobian @ chain, jacobian[:, :6], jacobian[:, 6:]]

    rows = 13 if isinstance(block, SurfaceBlock) else 7
    noise = gtsam.noiseModel.Unit.Create(rows)
    return custom_factor(noise, [key_cloud, key_a, key_b], linearize)


def _error_and_jacobian(
    block: PairBlock, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3
) -> tuple[Array, Array]:
    """(13,) error and (13, 12) Jacobian, or (7,) and (7, 12)."""
    if isinstance(block, SurfaceBlock):
        return square_root(block.sums(T_lidar_a, T_lidar_b))
    T_a_b = T_lidar_a.between(T_lidar_b)
    if isinstance(block, ProjectionBlock):
        error, jacobian = block.error_and_jacobian(T_a_b)
    else:
        error, jacobian = square_root(block.sums(T_a_b))
    return error, jacobian @ pair_chain(T_lidar_a, T_lidar_b)


def pair_sums(block: PairBlock, T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> BlockSums:
    """H (12, 12), b (12,) and c of a block, in the tangents of both poses, first A's."""
    if isinstance(block, SurfaceBlock):
        return block.sums(T_lidar_a, T_lidar_b)
    sums = block.sums(T_lidar_a.between(T_lidar_b))
    chain = pair_chain(T_lidar_a, T_lidar_b)
    return BlockSums(chain.T @ sums.hessian @ chain, chain.T @ sums.gradient, sums.cost)


def pair_run_sums(
    block: PairBlock, T_lidar_a: Array, T_lidar_b: Array, edges: NDArray[np.int64]
) -> BlockSums:
    """As :func:`pair_sums` of each run of the features at poses of its own, stacked.

    Args:
        block: of features of camera A, seen in camera B.
        T_lidar_a: (r, 4, 4) of each run.
        T_lidar_b: (r, 4, 4) of each run.
        edges: (r + 1,) where the runs begin, and the end.
    """
    if isinstance(block, SurfaceBlock):
        return block.run_sums(T_lidar_a, T_lidar_b, edges)
    poses = [(gtsam.Pose3(a), gtsam.Pose3(b)) for a, b in zip(T_lidar_a, T_lidar_b, strict=True)]
    chains = np.stack([pair_chain(a, b) for a, b in poses])
    if isinstance(block, ProjectionBlock):
        T_b_a = np.stack([b.between(a).matrix() for a, b in poses])
        sums = block.run_sums(T_b_a, to_runs(edges))
    else:
        sums = block.run_sums(np.stack([a.between(b).matrix() for a, b in poses]), edges)
    turned = chains.transpose(0, 2, 1)
    gradient = (turned @ sums.gradient[..., None])[..., 0]
    return BlockSums(turned @ sums.hessian @ chains, gradient, sums.cost)


def pair_chain(T_lidar_a: gtsam.Pose3, T_lidar_b: gtsam.Pose3) -> Array:
    """(6, 12) derivative of the tangent of ``T_a_b`` by the tangents of both poses."""
    T_b_a = T_lidar_b.between(T_lidar_a)
    return np.hstack([-T_b_a.AdjointMap(), np.eye(6)])


def factor_on_two_poses(
    noise: gtsam.noiseModel.Base,
    key_a: int,
    key_b: int,
    residual: Callable[[gtsam.Pose3, gtsam.Pose3], tuple[Array, Array]],
) -> gtsam.CustomFactor:
    """A factor of (m,) residuals with (m, 12) Jacobians, in the tangents of both poses."""

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        found, jacobian = residual(values.atPose3(key_a), values.atPose3(key_b))
        return found, [jacobian[:, :6], jacobian[:, 6:]]

    return custom_factor(noise, [key_a, key_b], linearize)
