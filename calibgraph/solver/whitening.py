"""Weights and information of the residuals (paper, "Confidence-Weighted Residuals").

A residual is whitened by an upper triangular 2x2 matrix S: S^T S is its squared weight times the
information of its pixel. A match on an edge has information of rank one: it constrains one
direction only.
"""

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences

IDENTITY = np.array([1.0, 0.0, 1.0])
"""The entries (0,0), (0,1), (1,1) of the 2x2 identity."""

MEDIAN_NORM = np.array([0.67449, 1.17741])  # of a standard Gaussian error in 1 and 2 dimensions


def sqrt_information(table: Correspondences, config: Config) -> Array | None:
    """Whitening matrices of the residuals, w_k times the root of the information.

    Returns:
        (n, 3) entries (0,0), (0,1), (1,1) of upper triangular S with S^T S = w^2 I; None if every
        weight is one and no information is given.
    """
    if table.information_px is None and not config.confidence_weights:
        return None
    if table.information_px is None:
        root = np.tile(IDENTITY, (len(table), 1))
    else:
        root = upper_root(table.information_px)
    if config.confidence_weights:  # the paper's w = sqrt(clip(c, 0.1, 1))
        root *= np.sqrt(np.clip(table.confidence, 0.1, 1.0))[:, None]
    return root


def upper_root(information: Array) -> Array:
    """Upper triangular S with S^T S = I, row-wise; rank one gives s11 = 0 (or s00 = s01 = 0)."""
    uu, uv, vv = information.T
    s00 = np.sqrt(uu)
    s01 = np.where(uu > 0, uv / np.where(uu > 0, s00, 1.0), 0.0)
    s11 = np.sqrt(np.maximum(vv - s01**2, 0.0))
    return np.stack([s00, s01, s11], axis=1)


def constrained_error_px(residuals: Array, information: Array | None) -> Array:
    """(n,) length of the residual along the directions that the match constrains [px].

    The plain reprojection error where no information is given; for an edge, the distance from it.
    """
    if information is None:
        x, y = residuals.T
        return np.asarray(np.sqrt(x * x + y * y))  # hypot takes ten times as long
    uu, uv, vv = information.T
    x, y = residuals.T
    squared = uu * x**2 + 2 * uv * x * y + vv * y**2
    return np.asarray(np.sqrt(np.maximum(squared, 0.0) / largest_eigenvalue(information)))


def error_gradient(residuals: Array, errors: Array, information: Array | None) -> Array:
    """(n, 2) derivative of :func:`constrained_error_px` by the residual.

    Args:
        residuals: (n, 2).
        errors: (n,) these errors.
        information: (n, 3) or None.
    """
    safe = np.maximum(errors, np.finfo(float).tiny)[:, None]
    if information is None:
        return np.asarray(residuals / safe)
    uu, uv, vv = information.T
    x, y = residuals.T
    along = np.column_stack([uu * x + uv * y, uv * x + vv * y])
    return np.asarray(along / (largest_eigenvalue(information)[:, None] * safe))


def constrained_root(information: Array) -> Array:
    """(n, 3) whitening matrices that make a residual's norm its constrained error."""
    return upper_root(information / largest_eigenvalue(information)[:, None])


def largest_eigenvalue(information: Array) -> Array:
    """(n,) of (n, 3) symmetric 2x2 matrices, given by their entries uu, uv, vv."""
    uu, uv, vv = information.T
    return np.asarray((uu + vv) / 2 + np.hypot((uu - vv) / 2, uv))


def median_norm(information: Array | None) -> Array:
    """() or (n,) medians of a standard Gaussian error, of as many axes as are constrained."""
    if information is None:
        return np.asarray(MEDIAN_NORM[1])
    uu, uv, vv = information.T
    rank_one = uu * vv - uv**2 <= 1e-3 * (uu + vv) ** 2
    return np.asarray(MEDIAN_NORM[np.where(rank_one, 0, 1)])


def whitened_norm(root: Array | None, residuals: Array) -> Array:
    """(n,) lengths of the residuals times their whitening matrices, (n, 3) as above."""
    if root is None:
        return constrained_error_px(residuals, None)
    first = root[:, 0] * residuals[:, 0] + root[:, 1] * residuals[:, 1]
    second = root[:, 2] * residuals[:, 1]
    return np.asarray(np.sqrt(first * first + second * second))
