"""Pose and further unknowns of one camera, such as those of its lens: a robust linear fit.

All unknowns are fitted together, once. The fit of some of them, the others held at zero, follows
from its quadratic.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import fill_twist_columns
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.spread_kernel import median
from calibgraph.solver.whitening import upper_root
from calibgraph.solver.within_place import WEAK
from factors import ProjectionBlock

Array = NDArray[np.float64]

MIN_ROWS = 30  # fewer correspondences do not determine further unknowns
_MAX_ITERATIONS = 20
_CONVERGED = 1e-3  # largest change of an error in a step, in units of the loss' scale
_WEAK = 1e-4  # information of an unknown: nearly free, so that a few matches have an inverse
_LOSS_MEDIANS = 2.0 * 1.4826  # loss scale of 2 standard deviations, by the median of the errors


@dataclass(frozen=True, eq=False)
class Freed:
    """Some of the unknowns, fitted with the pose.

    Attributes:
        twist: (6,) of the pose [rad, m].
        values: (m,) of the unknowns.
        sigmas: (m,) standard deviations, by the scatter of the frames and what they share; NaN with
            one frame.
        compensating: (6, m) twists by which the pose compensates for a unit of each.
        independent_shares: (m,) share (0 to 1, root mean square) of an unknown's Jacobian that is
            independent of the pose and of the others. Near zero, the unknown is not observable.
    """

    twist: Array
    values: Array
    sigmas: Array
    compensating: Array
    independent_shares: Array

    def only(self, *rows: int) -> Freed:
        """Some of these unknowns."""
        rest = self.values[[*rows]], self.sigmas[[*rows]], self.compensating[:, rows]
        return Freed(self.twist, *rest, self.independent_shares[[*rows]])


@dataclass(frozen=True, eq=False)
class LinearFit:
    """The minimum with all unknowns free, and what the fits of fewer are made of.

    Attributes:
        values: (6 + k,) twist of T_camera_lidar = exp(twist) estimate [rad, m], and the unknowns.
        hessian: (6 + k, 6 + k), by the weights at the minimum.
        gradients: (f, 6 + k) of the frames, there.
        shared: variance of what all frames share, which their scatter does not show, over that of
            independent matches.
    """

    values: Array
    hessian: Array
    gradients: Array
    shared: float

    def free(self, *unknowns: int) -> Freed:
        """The fit of the pose and some unknowns, with their numbers; the others are zero."""
        rows = np.array([*range(6), *(6 + number for number in unknowns)])
        own = self.hessian[np.ix_(rows, rows)]
        inverse = np.linalg.inv(own)
        values = inverse @ (self.hessian @ self.values)[rows]
        scatter = self._scatter(rows, own) + _weak(len(rows))
        whole = inverse @ scatter @ inverse + self.shared * inverse
        shares = 1 / np.sqrt(np.diag(inverse) * np.diag(own))
        compensating = np.asarray(-np.linalg.solve(own[:6, :6], own[:6, 6:]))
        sigmas = np.sqrt(np.diag(whole))
        return Freed(values[:6], values[6:], sigmas[6:], compensating, shares[6:])

    def _scatter(self, rows: NDArray[np.int64], hessian: Array) -> Array:
        """Of the gradients, with frames as clusters."""
        frames, pulls = len(self.gradients), self.gradients[:, rows]
        if frames < 2:  # noqa: PLR2004
            return np.full_like(hessian, np.nan)
        return with_pseudo_frames(pulls.T @ pulls, hessian, np.full(len(rows), float(frames)))


def linearize(camera: Camera, block: ProjectionBlock, fields_px: Array) -> Array:
    """(6 + k + 1, 2, n) whitened derivatives of the pixels, and last the whitened errors.

    Args:
        camera: lens, and the extrinsic about which is linearized: by a twist of it.
        block: its correspondences.
        fields_px: (k, 2, n) derivatives of the pixels by the unknowns.
    """
    columns = np.empty((7 + len(fields_px), 2, len(block)))
    pixels = fill_twist_columns(camera, block.points_lidar_m, columns[:6])
    columns[6:-1] = fields_px
    columns[-1] = camera.lens.subtract(block.pixels_px, pixels.T).T
    if block.sqrt_information is not None:
        s00, s01, s11 = block.sqrt_information.T
        columns[:, 0] = s00 * columns[:, 0] + s01 * columns[:, 1]
        columns[:, 1] *= s11
    return columns


def fit_linear(
    columns: Array,
    counts: NDArray[Any],
    *,
    loss_scale: float | None = None,
    shared_variance: float = 0.0,
) -> LinearFit | None:
    """Fit pose and unknowns with a Cauchy loss on the norm of each row's error.

    Args:
        columns: of :func:`linearize`, frame by frame.
        counts: (f,) rows of each frame.
        loss_scale: of the whitened errors; None: from their median, which holds for up to about a
            third of outliers.
        shared_variance: of what all frames share, over that of all matches if these were
            independent.

    Returns:
        The fit, or None of fewer than ``MIN_ROWS`` rows.
    """
    if columns.shape[2] < MIN_ROWS:
        return None
    size, errors = len(columns) - 1, columns[-1].ravel()
    flat = columns[:-1].reshape(size, -1)
    values = np.zeros(size)
    for _ in range(_MAX_ITERATIONS):
        weights, scale = _cauchy((errors - values @ flat).reshape(2, -1), loss_scale)
        weighted = flat * np.tile(weights, 2)
        hessian = weighted @ flat.T + _weak(size)
        before, values = values, np.linalg.solve(hessian, weighted @ errors)
        if np.abs((values - before) @ flat).max() < _CONVERGED * scale:
            break
    left = errors - values @ flat
    pulls = (weighted * left).reshape(size, 2, -1).sum(axis=1)
    gradients = np.add.reduceat(pulls, np.cumsum(counts) - counts, axis=1).T
    variance = float(np.tile(weights, 2) @ left**2 / (2 * weights.sum()))
    return LinearFit(values, hessian, gradients, shared_variance * variance)


def _weak(size: int) -> Array:
    """(6 + k, 6 + k) information of a pose within sight and of unknowns that are nearly free."""
    return np.diag([*np.diag(WEAK), *[_WEAK] * (size - 6)])


def _cauchy(errors: Array, loss_scale: float | None) -> tuple[Array, float]:
    """(n,) weights of (2, n) errors, and the scale of the loss."""
    squares = np.einsum("pn,pn->n", errors, errors)
    scale = loss_scale or _LOSS_MEDIANS * math.sqrt(median(squares)) + 1e-12
    return 1.0 / (1.0 + squares / scale**2), scale


def fit_table(
    camera: Camera, table: Correspondences, fields_px: Array, *, shared_variance: float = 0.0
) -> LinearFit | None:
    """:func:`fit_linear` of the rows of one camera, (k, 2, n) ``fields_px`` in their order."""
    rows = np.argsort(table.frame, kind="stable")
    table, fields_px = table.select(rows), fields_px[:, :, rows]
    root = None if table.information_px is None else upper_root(table.information_px)
    block = ProjectionBlock(camera.lens, table.points_lidar_m, table.pixels_px, root)
    counts = np.unique(table.frame, return_counts=True)[1]
    return fit_linear(linearize(camera, block, fields_px), counts, shared_variance=shared_variance)
