"""Thousands of robust projection factors of one camera as one 7-row factor, without approximation.

For correspondences k with whitened residual r_k, Jacobian J_k, s_k = |r_k|^2 and robust loss rho,

    H = sum psi_k J_k^T J_k     b = sum psi_k J_k^T r_k     c = sum rho(s_k),   psi_k = rho'(s_k).

A factor with Jacobian A = [M; 0] (7 x 6), M^T M = H, and error e = [M^-T b; sqrt(c - |M^-T b|^2)]
has A^T A = H, A^T e = b and |e|^2 = c: the linearization and the error are those of the separate
robust factors. The root is real, since |M^-T b|^2 <= sum psi_k s_k <= sum rho(s_k) for every loss
that is concave in s with rho(0) = 0.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.conditioning import unit_diagonal
from factors.kernel import (
    accumulate_alone,
    accumulate_shared,
    residuals_alone,
    residuals_shared,
)
from factors.lens import Lens
from factors.loss import loss_id

Array = NDArray[np.float64]

_CHUNK = 2048  # correspondences a task: fixed, so that sums do not depend on the thread count
_WORTH_SHARING = 300_000  # correspondences (1 ms): below, waking other threads costs more


@dataclass(frozen=True)
class BlockSums:
    """H, b and c of a block of correspondences at one pose. Sums of blocks simply add.

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
    """Correspondences of one camera, as a structure of arrays. Immutable: its arrays are read-only.

    Attributes:
        lens: the camera's lens.
        points_lidar_m: (n, 3) points in the LiDAR frame.
        pixels_px: (n, 2) observed pixels.
        sqrt_information: (n, 3) entries (0,0), (0,1), (1,1) of upper triangular whitening matrices
            [1/px], or None for the identity.
        loss: name of the robust loss.
        scale: norm of a whitened residual, divided by sigma, at which the loss bends (the paper's
            delta).
        sigma: what all whitened residuals are divided by.

    Raises:
        ValueError: on wrong shapes, values that are not finite, an unknown loss, a scale or sigma
            <= 0.
    """

    lens: Lens
    points_lidar_m: Array
    pixels_px: Array
    sqrt_information: Array | None = None
    loss: str = "cauchy"
    scale: float = 4.0
    sigma: float = 1.0
    _columns: Array = field(init=False, repr=False)  # (5, n) x y z u v, contiguous by row
    _whitening: Array = field(init=False, repr=False)  # (3, n), (1, n) or (0, n), see the kernel

    def __post_init__(self) -> None:
        n = len(self.points_lidar_m)
        _check_shape("points_lidar_m", self.points_lidar_m, (n, 3))
        _check_shape("pixels_px", self.pixels_px, (n, 2))
        if self.sqrt_information is not None:
            _check_shape("sqrt_information", self.sqrt_information, (n, 3))
        loss_id(self.loss)
        _check_positive(scale=self.scale, sigma=self.sigma)
        columns = np.empty((5, n))
        columns[:3], columns[3:] = self.points_lidar_m.T, self.pixels_px.T
        self._initialize(columns, _whitening(self.sqrt_information, n), self.sqrt_information)

    def _initialize(self, columns: Array, whitening: Array, root: Array | None) -> None:
        """Set the arrays of a block that is being made: held once, as columns, and read-only."""
        columns, whitening = _read_only(columns), _read_only(whitening)
        object.__setattr__(self, "_columns", columns)
        object.__setattr__(self, "_whitening", whitening)
        object.__setattr__(self, "points_lidar_m", columns[:3].T)
        object.__setattr__(self, "pixels_px", columns[3:].T)
        object.__setattr__(self, "sqrt_information", None if root is None else _read_only(root))

    def __len__(self) -> int:
        return len(self.pixels_px)

    def rescale(self, *, scale: float, sigma: float = 1.0) -> ProjectionBlock:
        """The same correspondences, not copied, with another scale of the loss, and sigma."""
        _check_positive(scale=scale, sigma=sigma)
        other = copy.copy(self)  # not checked again: its correspondences are those of a good block
        object.__setattr__(other, "scale", scale)
        object.__setattr__(other, "sigma", sigma)
        return other

    def select(self, rows: NDArray[Any]) -> ProjectionBlock:
        """The block with only some correspondences: a mask or an index array."""
        rows = np.flatnonzero(rows) if rows.dtype == np.bool_ else rows
        root = self.sqrt_information
        other = copy.copy(self)
        other._initialize(
            self._columns.take(rows, axis=1),
            self._whitening.take(rows, axis=1),
            None if root is None else root[rows],
        )
        return other

    @staticmethod
    def join(parts: Sequence[ProjectionBlock]) -> ProjectionBlock:
        """The correspondences of blocks of one lens under each other; loss as of the first."""
        roots = _joined_roots(parts)
        joined, columns = copy.copy(parts[0]), np.hstack([part._columns for part in parts])
        joined._initialize(columns, _whitening(roots, columns.shape[1]), roots)
        return joined

    def sums(self, T_lidar_camera: gtsam.Pose3) -> BlockSums:
        """H, b and c of the whole block at a pose, in one pass over the data."""
        return unpack_sums(self._segment_sums([T_lidar_camera], self._chunk_edges())[0].sum(axis=0))

    def sums_at(self, poses: Sequence[gtsam.Pose3]) -> BlockSums:
        """H, b and c of the whole block at each of some T_lidar_camera, stacked."""
        return unpack_sums(self._segment_sums(poses, self._chunk_edges()).sum(axis=1))

    def frame_sums(self, T_lidar_camera: gtsam.Pose3, edges: ArrayLike) -> BlockSums:
        """H, b and c of each run ``edges[i]:edges[i + 1]`` of the correspondences, stacked."""
        runs = np.asarray(edges, dtype=np.int64)
        return unpack_sums(self._segment_sums([T_lidar_camera], runs)[0])

    def _chunk_edges(self) -> NDArray[np.int64]:
        """Where runs of _CHUNK correspondences begin, and the end."""
        count = -(-len(self) // _CHUNK)
        return np.minimum(np.arange(count + 1) * _CHUNK, len(self))

    def _segment_sums(self, poses: Sequence[gtsam.Pose3], edges: NDArray[np.int64]) -> Array:
        """(p, s, 28) sums of the kernel at each T_lidar_camera, over each run."""
        run = accumulate_alone if len(self) < _WORTH_SHARING else accumulate_shared
        T_camera_lidar = np.array([T.inverse().matrix() for T in poses])
        # Every loss has rho(s / sigma^2; delta) = rho(s; delta sigma) / sigma^2.
        sums: Array = run(
            self.lens.kind, self.lens.packed, T_camera_lidar, self._columns,
            self._whitening, loss_id(self.loss), self.scale * self.sigma, edges,
        )  # fmt: skip
        return sums if self.sigma == 1.0 else sums / self.sigma**2

    def residuals(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) unweighted residuals ``pi - u`` [px]; (n,) whether the point is projectable."""
        run = residuals_alone if len(self) < _WORTH_SHARING else residuals_shared
        residuals, projectable = run(
            self.lens.kind, self.lens.packed, _T_camera_lidar(T_lidar_camera), self._columns
        )
        return residuals, projectable

    def error_and_jacobian(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, Array]:
        """The (7,) error and (7, 6) Jacobian of the block factor."""
        return square_root(self.sums(T_lidar_camera))


def block_factor(key: int, block: ProjectionBlock) -> gtsam.CustomFactor:
    """The block as one factor on the variable ``T_lidar_camera``, equal to its separate factors.

    The factor remembers the error and Jacobian of its last pose: an optimizer evaluates the error
    of a step and then linearizes at the same pose, which takes one pass over the correspondences.
    They are replaced as one tuple, so that threads never see a pose with the sums of another.
    """
    last: tuple[bytes, tuple[Array, Array]] | None = None

    def error(
        factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Array] | None
    ) -> Array:
        nonlocal last
        T_lidar_camera = values.atPose3(key)
        pose, found = T_lidar_camera.matrix().tobytes(), last
        if found is None or found[0] != pose:
            last = found = (pose, block.error_and_jacobian(T_lidar_camera))
        residual, jacobian = found[1]
        if jacobians is not None:
            jacobians[0] = jacobian
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(7), [key], error)


def square_root(sums: BlockSums) -> tuple[Array, Array]:
    """(n + 1,) error and (n + 1, n) Jacobian with the given H, b and c; H may be rank deficient.

    H is scaled to a unit diagonal before its eigenvectors are taken, so that radians and metres
    lose no digits to each other; directions without information get a zero row.
    """
    n = len(sums.hessian)
    scaled, units = unit_diagonal(sums.hessian)
    values, vectors = np.linalg.eigh(scaled)
    informed = values > 1e-14 * max(float(values[-1]), 0.0)
    roots = np.sqrt(np.where(informed, values, 0.0))
    over = np.where(informed, 1.0 / np.where(informed, roots, 1.0), 0.0)
    jacobian = np.zeros((n + 1, n), order="F")
    jacobian[:n] = roots[:, None] * vectors.T * units
    error = np.empty(n + 1)
    error[:n] = over * (vectors.T @ (sums.gradient / units))
    error[n] = np.sqrt(max(float(sums.cost) - float(error[:n] @ error[:n]), 0.0))
    return error, jacobian


def _T_camera_lidar(T_lidar_camera: gtsam.Pose3) -> Array:
    return np.ascontiguousarray(T_lidar_camera.inverse().matrix())


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"the robust {name} must be positive, found {value}")


def _check_shape(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise ValueError(f"{name}[{row}] is not finite: {array[row]}")


def _joined_roots(parts: Sequence[ProjectionBlock]) -> Array | None:
    """Whitening matrices of blocks under each other; the identity where a block has none."""
    roots = [part.sqrt_information for part in parts]
    if all(root is None for root in roots):
        return None
    return np.concatenate([
        np.tile([1.0, 0.0, 1.0], (len(part), 1)) if root is None else root
        for root, part in zip(roots, parts, strict=True)
    ])  # fmt: skip


def _whitening(root: Array | None, n: int) -> Array:
    """The whitening for the kernel: matrices by columns, or (1, n) if they are all numbers."""
    if root is None:
        return np.empty((0, n))
    isotropic = not root[:, 1].any() and np.array_equal(root[:, 0], root[:, 2])
    return np.ascontiguousarray((root[:, :1] if isotropic else root).T)


_UPPER = np.triu_indices(6)


def unpack_sums(sums: Array) -> BlockSums:
    """Split (..., 28) kernel sums: 21 of the upper triangle of H, 6 of b, 1 of c."""
    hessian = np.empty((*sums.shape[:-1], 6, 6))
    hessian[..., _UPPER[0], _UPPER[1]] = sums[..., :21]
    hessian[..., _UPPER[1], _UPPER[0]] = sums[..., :21]
    return BlockSums(hessian, sums[..., 21:27], sums[..., 27])
