"""The sums H, b and c of a block of correspondences, and the root that GTSAM is given."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factors.block_arrays import contiguous
from factors.conditioning import fill_root, unit_diagonal

Array = NDArray[np.float64]

_LEAST = 1e-14  # of the largest eigenvalue: below, a direction counts as free


@dataclass(frozen=True)
class BlockSums:
    """H, b and c of a block of correspondences at one pose. Sums of blocks simply add.

    Attributes:
        hessian: (6, 6) or (f, 6, 6), H above, in GTSAM's tangent of ``T_lidar_camera``.
        gradient: (6,) or (f, 6), b above.
        cost: () or (f,), c above; GTSAM's error is half of it.
        curvature: the second derivative of half the cost, like ``hessian``, where it was asked
            for; but for the second derivative of the residuals, which is their noise over the focal
            length as large.
    """

    hessian: Array
    gradient: Array
    cost: Array
    curvature: Array | None = None


def square_root(sums: BlockSums) -> tuple[Array, Array]:
    """(n + 1,) error and (n + 1, n) Jacobian with the given H, b and c; H may be rank deficient.

    H is scaled to a unit diagonal before its root is taken, so that radians and metres lose no
    digits to each other. The root is triangular; where H is nearly rank deficient, it is by the
    eigenvectors, and directions without information get a zero row.
    """
    size = len(sums.gradient)
    error, jacobian = np.empty(size + 1), np.zeros((size, size + 1))
    hessian, gradient = contiguous(sums.hessian), contiguous(sums.gradient)
    if fill_root(hessian, gradient, float(sums.cost), error, jacobian):
        return error, jacobian.T
    scaled, units = unit_diagonal(hessian)
    values, vectors = np.linalg.eigh(scaled)
    known = values > _LEAST * max(values[-1], 0.0)
    roots = np.sqrt(np.where(known, values, 1.0))
    error[:size] = np.where(known, vectors.T @ (gradient / units) / roots, 0.0)
    error[size] = math.sqrt(max(float(sums.cost) - float(error[:size] @ error[:size]), 0.0))
    jacobian[:, :size] = (vectors * np.where(known, roots, 0.0)) * units[:, None]
    jacobian[:, size] = 0.0
    return error, jacobian.T


def sums_of_runs(rows: Array, losses: Array, edges: NDArray[np.int64]) -> BlockSums:
    """H, b and c of runs of linearized residuals, stacked.

    Args:
        rows: (m n, k + 1) Jacobians and residuals, times the root of the loss' weight; m rows of
            each of n features.
        losses: (n,).
        edges: (r + 1,) where the runs of features begin, and the end.
    """
    starts, each = (edges - edges[0])[1:-1], len(rows) // max(len(losses), 1)
    sums = np.array([part.T @ part for part in np.split(rows, each * starts)])
    costs = np.array([part.sum() for part in np.split(losses, starts)])
    return BlockSums(sums[:, :-1, :-1], sums[:, :-1, -1], costs)


_PLACES = np.array([[min(i, j) * (11 - min(i, j)) // 2 + max(i, j) for j in range(6)]
                    for i in range(6)])  # fmt: skip


def unpack_sums(sums: Array) -> BlockSums:
    """Split (..., 28 or 49) kernel sums: 21 of the upper triangle of H, 6 of b, 1 of c, 21 more."""
    more = sums[..., 28:]
    curvature = more.take(_PLACES, axis=-1) if more.shape[-1] else None
    return BlockSums(sums.take(_PLACES, axis=-1), sums[..., 21:27], sums[..., 27], curvature)
