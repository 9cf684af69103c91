"""Thousands of robust projection factors of one camera as one 7-row factor, without loss.

For correspondences k with whitened residual r_k, Jacobian J_k, s_k = |r_k|^2 and robust loss rho,

    H = sum psi_k J_k^T J_k     b = sum psi_k J_k^T r_k     c = sum rho(s_k),   psi_k = rho'(s_k).

A factor with Jacobian A = [M; 0] (7 x 6), M^T M = H, and error e = [M^-T b; sqrt(c - |M^-T b|^2)]
has A^T A = H, A^T e = b and |e|^2 = c: the linearization and the error are those of the separate
robust factors. The root is real, since |M^-T b|^2 <= sum psi_k s_k <= sum rho(s_k) for every loss
that is concave in s with rho(0) = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import gtsam
import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from factors.lens import MIN_DEPTH_M, PINHOLE, Lens, is_projectable, project_one
from factors.loss import CAUCHY, loss_and_weight, loss_id

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
    _last: list[tuple[bytes, tuple[Array, Array]]] = field(default_factory=list, repr=False)

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
        run = _accumulate_alone if len(self) < _WORTH_SHARING else _accumulate_shared
        sums: Array = run(
            self.lens.kind, self.lens.packed, T, columns, whitening,
            loss_id(self.loss), self.scale, edges,
        )  # fmt: skip
        return sums

    def residuals(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) unweighted residuals ``pi - u`` [px]; (n,) whether the point is projectable."""
        columns, _ = self._columns
        T = np.ascontiguousarray(T_lidar_camera.inverse().matrix())
        residuals, valid = _residuals(self.lens.kind, self.lens.packed, T, columns)
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


_FAST = {"reassoc", "contract", "nsz", "arcp"}
_SMALL = 1e-200  # far from the smallest float by more than one factor
_TILE = 128  # correspondences whose 12 intermediate values stay in the first-level cache
(_RU, _RV, _UX, _UY, _UZ, _VX, _VY, _VZ, _X, _Y, _Z, _PSI) = range(12)  # rows of a tile


def _accumulate(kind, lens, T, columns, whitening, loss, scale, edges):  # type: ignore[no-untyped-def]
    """(segments, 28) sums over the runs ``edges[i]:edges[i + 1]`` of the correspondences.

    Each run is cut into tiles, and a tile goes through four loops that vectorize.
    """
    out = np.zeros((len(edges) - 1, 28))
    for segment in prange(len(edges) - 1):
        tile = np.empty((12, _TILE))
        for start in range(edges[segment], edges[segment + 1], _TILE):
            n = min(_TILE, edges[segment + 1] - start)
            if kind == PINHOLE:
                _project_pinhole(lens, T, columns, start, n, tile)
            else:
                _project(kind, lens, T, columns, start, n, tile)
            if whitening.shape[1] > 0:
                _whiten(whitening, start, n, tile)
            out[segment, 27] += _weigh(loss, scale, n, tile)
            _sum_tile(n, tile, out, segment)
    return out


_accumulate_alone = njit(cache=True)(_accumulate)
_accumulate_shared = njit(cache=True, parallel=True)(_accumulate)


@njit(cache=True, fastmath=_FAST)
def _project_pinhole(lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """``_project`` for a pinhole without distortion: no branch, so that it vectorizes."""
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    for i in range(n):
        px, py, pz = columns[0, start + i], columns[1, start + i], columns[2, start + i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        w = 1.0 / max(z, MIN_DEPTH_M)
        wz = w if z > MIN_DEPTH_M else 0.0
        u, v = fx * x * w, fy * y * w
        tile[_RU, i] = u + cx - columns[3, start + i]
        tile[_RV, i] = v + cy - columns[4, start + i]
        tile[_UX, i], tile[_UY, i], tile[_UZ, i] = fx * w, 0.0, -u * wz
        tile[_VX, i], tile[_VY, i], tile[_VZ, i] = 0.0, fy * w, -v * wz
        tile[_X, i], tile[_Y, i], tile[_Z, i] = x, y, z


@njit(cache=True, fastmath=_FAST)
def _project(kind, lens, T, columns, start, n, tile):  # type: ignore[no-untyped-def]
    """Residuals, their derivatives by the point, and the point in the camera frame."""
    for i in range(n):
        px, py, pz = columns[0, start + i], columns[1, start + i], columns[2, start + i]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        u, v, ux, uy, uz, vx, vy, vz = project_one(kind, lens, x, y, z)
        tile[_RU, i] = u - columns[3, start + i]
        tile[_RV, i] = v - columns[4, start + i]
        tile[_UX, i], tile[_UY, i], tile[_UZ, i] = ux, uy, uz
        tile[_VX, i], tile[_VY, i], tile[_VZ, i] = vx, vy, vz
        tile[_X, i], tile[_Y, i], tile[_Z, i] = x, y, z


@njit(cache=True, fastmath=_FAST)
def _whiten(whitening, start, n, tile):  # type: ignore[no-untyped-def]
    """Multiply residuals and derivatives by the upper triangular whitening matrices."""
    for i in range(n):
        s00, s01, s11 = whitening[0, start + i], whitening[1, start + i], whitening[2, start + i]
        tile[_RU, i] = s00 * tile[_RU, i] + s01 * tile[_RV, i]
        tile[_UX, i] = s00 * tile[_UX, i] + s01 * tile[_VX, i]
        tile[_UY, i] = s00 * tile[_UY, i] + s01 * tile[_VY, i]
        tile[_UZ, i] = s00 * tile[_UZ, i] + s01 * tile[_VZ, i]
        tile[_RV, i] *= s11
        tile[_VX, i] *= s11
        tile[_VY, i] *= s11
        tile[_VZ, i] *= s11


@njit(cache=True, fastmath=_FAST)
def _weigh(loss, scale, n, tile):  # type: ignore[no-untyped-def]
    """Fill in the weights psi; return the sum of rho."""
    if loss != CAUCHY:
        cost = 0.0
        for i in range(n):
            rho, tile[_PSI, i] = loss_and_weight(
                loss, scale, tile[_RU, i] * tile[_RU, i] + tile[_RV, i] * tile[_RV, i]
            )
            cost += rho
        return cost
    k = 1.0 / (scale * scale)
    for i in range(n):
        ratio = 1.0 + k * (tile[_RU, i] * tile[_RU, i] + tile[_RV, i] * tile[_RV, i])
        tile[_PSI, i] = 1.0 / ratio
    # The sum of logarithms is the logarithm of the product, taken before it leaves the range of
    # a float: a division and a multiplication each instead of a logarithm.
    logarithms, product = 0.0, 1.0
    for i in range(n):
        product *= tile[_PSI, i]
        if product < _SMALL:
            logarithms += math.log(product)
            product = 1.0
    return -(logarithms + math.log(product)) / k


@njit(cache=True, fastmath=_FAST)
def _sum_tile(n, tile, out, segment):  # type: ignore[no-untyped-def]
    """Add J^T psi J and J^T psi r of a tile to the 27 sums of a segment."""
    h00 = h01 = h02 = h03 = h04 = h05 = h11 = h12 = h13 = h14 = h15 = 0.0
    h22 = h23 = h24 = h25 = h33 = h34 = h35 = h44 = h45 = h55 = 0.0
    b0 = b1 = b2 = b3 = b4 = b5 = 0.0
    for i in range(n):
        # q = X^-1 p:  dq / d(rotation, translation) = ([q]x, -I);  g^T [q]x = (g x q)^T.
        x, y, z, psi = tile[_X, i], tile[_Y, i], tile[_Z, i], tile[_PSI, i]
        u3, u4, u5 = -tile[_UX, i], -tile[_UY, i], -tile[_UZ, i]
        v3, v4, v5 = -tile[_VX, i], -tile[_VY, i], -tile[_VZ, i]
        u0, u1, u2 = u5 * y - u4 * z, u3 * z - u5 * x, u4 * x - u3 * y
        v0, v1, v2 = v5 * y - v4 * z, v3 * z - v5 * x, v4 * x - v3 * y
        a0, a1, a2, a3, a4, a5 = psi * u0, psi * u1, psi * u2, psi * u3, psi * u4, psi * u5
        c0, c1, c2, c3, c4, c5 = psi * v0, psi * v1, psi * v2, psi * v3, psi * v4, psi * v5
        ru, rv = tile[_RU, i], tile[_RV, i]
        h00 += a0 * u0 + c0 * v0
        h01 += a0 * u1 + c0 * v1
        h02 += a0 * u2 + c0 * v2
        h03 += a0 * u3 + c0 * v3
        h04 += a0 * u4 + c0 * v4
        h05 += a0 * u5 + c0 * v5
        h11 += a1 * u1 + c1 * v1
        h12 += a1 * u2 + c1 * v2
        h13 += a1 * u3 + c1 * v3
        h14 += a1 * u4 + c1 * v4
        h15 += a1 * u5 + c1 * v5
        h22 += a2 * u2 + c2 * v2
        h23 += a2 * u3 + c2 * v3
        h24 += a2 * u4 + c2 * v4
        h25 += a2 * u5 + c2 * v5
        h33 += a3 * u3 + c3 * v3
        h34 += a3 * u4 + c3 * v4
        h35 += a3 * u5 + c3 * v5
        h44 += a4 * u4 + c4 * v4
        h45 += a4 * u5 + c4 * v5
        h55 += a5 * u5 + c5 * v5
        b0 += a0 * ru + c0 * rv
        b1 += a1 * ru + c1 * rv
        b2 += a2 * ru + c2 * rv
        b3 += a3 * ru + c3 * rv
        b4 += a4 * ru + c4 * rv
        b5 += a5 * ru + c5 * rv
    sums = (
        h00, h01, h02, h03, h04, h05, h11, h12, h13, h14, h15, h22, h23, h24, h25, h33, h34, h35,
        h44, h45, h55, b0, b1, b2, b3, b4, b5,
    )  # fmt: skip
    for k in range(27):
        out[segment, k] += sums[k]


@njit(cache=True)
def _residuals(kind, lens, T, columns):  # type: ignore[no-untyped-def]
    n = columns.shape[1]
    residuals = np.empty((n, 2))
    valid = np.empty(n, dtype=np.bool_)
    for k in range(n):
        px, py, pz = columns[0, k], columns[1, k], columns[2, k]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        projection = project_one(kind, lens, x, y, z)
        residuals[k, 0] = projection[0] - columns[3, k]
        residuals[k, 1] = projection[1] - columns[4, k]
        valid[k] = is_projectable(kind, lens, x, y, z)
    return residuals, valid
