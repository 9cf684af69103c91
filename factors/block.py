"""Thousands of robust projection factors of one camera as one 7-row factor, without loss.

For correspondences k with whitened residual r_k, Jacobian J_k, s_k = |r_k|^2 and robust loss rho,

    H = sum psi_k J_k^T J_k     b = sum psi_k J_k^T r_k     c = sum rho(s_k),   psi_k = rho'(s_k).

A factor with Jacobian A = [M; 0] (7 x 6), M^T M = H, and error e = [M^-T b; sqrt(c - |M^-T b|^2)]
has A^T A = H, A^T e = b and |e|^2 = c: the linearization and the error are those of the separate
robust factors. The root is real, since |M^-T b|^2 <= sum psi_k s_k <= sum rho(s_k) for every loss
that is concave in s with rho(0) = 0.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.kernel import accumulate_alone, accumulate_shared, residuals_of
from factors.lens import Lens
from factors.loss import loss_id

Array = NDArray[np.float64]

_CHUNK = 2048  # correspondences a task: fixed, so that sums do not depend on the thread count
_WORTH_SHARING = 300_000  # correspondences (2 ms): below, waking other threads costs more


@dataclass(frozen=True)
class BlockSums:
    """What a block of correspondences says at one pose. Sums of blocks simply add.

    Attributes:
        hessian: (6, 6) or (f, 6, 6), H above, in GTSAM's tangent of ``T_lidar_camera``.
        gradient: (6,) or (f, 6), b above.
        cost: () or (f,), c above; GTSAM's error is half of it.
    """

    hessian: Array
    gradient: Array
    cost: Array


@dataclass(frozen=True, eq=False)
class ProjectionBlock:
    """Correspondences of one camera, as a structure of arrays.

    Attributes:
        lens: the camera's lens.
        points_lidar_m: (n, 3) points in the LiDAR frame.
        pixels_px: (n, 2) observed pixels.
        sqrt_information: (n, 3) entries (0,0), (0,1), (1,1) of upper triangular whitening matrices
            [1/px], or None for the identity.
        loss: name of the robust loss.
        scale: whitened residual norm at which the loss bends (the paper's delta).

    Raises:
        ValueError: on wrong shapes, values that are not finite, an unknown loss, a scale <= 0.
    """

    lens: Lens
    points_lidar_m: Array
    pixels_px: Array
    sqrt_information: Array | None = None
    loss: str = "cauchy"
    scale: float = 4.0
    _last: list[tuple[bytes, tuple[Array, Array]]] = field(
        default_factory=list, init=False, repr=False
    )

    def __post_init__(self) -> None:
        n = len(self.points_lidar_m)
        _check_shape("points_lidar_m", self.points_lidar_m, (n, 3))
        _check_shape("pixels_px", self.pixels_px, (n, 2))
        if self.sqrt_information is not None:
            _check_shape("sqrt_information", self.sqrt_information, (n, 3))
        loss_id(self.loss)
        if not self.scale > 0:
            raise ValueError(f"the robust scale must be positive, found {self.scale}")

    def __len__(self) -> int:
        return len(self.points_lidar_m)

    @cached_property
    def _columns(self) -> tuple[Array, Array]:
        """(5, n) x y z u v and (3, n) or (3, 0) whitening, contiguous by row for the kernel."""
        columns = np.ascontiguousarray(np.hstack([self.points_lidar_m, self.pixels_px]).T)
        whitening = np.empty((0, 3)) if self.sqrt_information is None else self.sqrt_information
        return columns, np.ascontiguousarray(whitening.T)

    def sums(self, T_lidar_camera: gtsam.Pose3) -> BlockSums:
        """H, b and c of the whole block at a pose, in one pass over the data."""
        edges = np.append(np.arange(0, len(self), _CHUNK), len(self))
        return _unpacked(self._segment_sums(T_lidar_camera, edges).sum(axis=0))

    def frame_sums(self, T_lidar_camera: gtsam.Pose3, edges: ArrayLike) -> BlockSums:
        """H, b and c of each run ``edges[i]:edges[i + 1]`` of the correspondences, stacked."""
        return _unpacked(self._segment_sums(T_lidar_camera, np.asarray(edges, dtype=np.int64)))

    def _segment_sums(self, T_lidar_camera: gtsam.Pose3, edges: NDArray[np.int64]) -> Array:
        columns, whitening = self._columns
        T = np.ascontiguousarray(T_lidar_camera.inverse().matrix())
        run = accumulate_alone if len(self) < _WORTH_SHARING else accumulate_shared
        sums: Array = run(
            self.lens.kind, self.lens.packed, T, columns, whitening,
            loss_id(self.loss), self.scale, edges,
        )  # fmt: skip
        return sums

    def residuals(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) unweighted residuals ``pi - u`` [px]; (n,) whether the point is projectable."""
        columns, _ = self._columns
        T = np.ascontiguousarray(T_lidar_camera.inverse().matrix())
        residuals, valid = residuals_of(self.lens.kind, self.lens.packed, T, columns)
        return residuals, valid

    def error_and_jacobian(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, Array]:
        """The (7,) error and (7, 6) Jacobian of the block factor.

        The last pose is remembered: an optimizer that judges a step and then linearizes there pays
        for one pass.
        """
        pose = T_lidar_camera.matrix().tobytes()
        if not self._last or self._last[0][0] != pose:
            self._last[:] = [(pose, square_root(self.sums(T_lidar_camera)))]
        return self._last[0][1]


def block_factor(key: int, block: ProjectionBlock) -> gtsam.CustomFactor:
    """The block as one factor on the variable ``T_lidar_camera``, equal to its separate factors."""

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        residual, jacobian = block.error_and_jacobian(values.atPose3(key))
        if jacobians is not None:
            jacobians[0] = jacobian
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(7), [key], error)


def square_root(sums: BlockSums) -> tuple[Array, Array]:
    """(7,) error and (7, 6) Jacobian with the given H, b and c; H may be rank deficient.

    H is scaled to a unit diagonal before its eigenvectors are taken, so that radians and metres
    lose no digits to each other; directions without information get a zero row.
    """
    diagonal = np.sqrt(np.diag(sums.hessian))
    units = np.where(diagonal > 0, diagonal, 1.0)
    values, vectors = np.linalg.eigh(sums.hessian / np.outer(units, units))
    informed = values > 1e-14 * max(float(values[-1]), 0.0)
    roots = np.sqrt(np.where(informed, values, 0.0))
    over = np.where(informed, 1.0 / np.where(informed, roots, 1.0), 0.0)
    jacobian = np.zeros((7, 6), order="F")
    jacobian[:6] = roots[:, None] * vectors.T * units
    error = np.empty(7)
    error[:6] = over * (vectors.T @ (sums.gradient / units))
    error[6] = np.sqrt(max(float(sums.cost) - float(error[:6] @ error[:6]), 0.0))
    return error, jacobian


def _check_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ValueError(f"{name}[{row}] is not finite: {array[row]}")


_UPPER = np.triu_indices(6)


def _unpacked(sums: Array) -> BlockSums:
    """Split (..., 28) kernel sums: 21 of the upper triangle of H, 6 of b, 1 of c."""
    hessian = np.empty((*sums.shape[:-1], 6, 6))
    hessian[..., _UPPER[0], _UPPER[1]] = sums[..., :21]
    hessian[..., _UPPER[1], _UPPER[0]] = sums[..., :21]
    return BlockSums(hessian, sums[..., 21:27], sums[..., 27])
