"""Pose and further unknowns of one camera, such as those of its lens: a robust linear fit.

All unknowns are fitted together, once. The fit of some of them, the others held at zero, follows
from its quadratic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import fill_twist_columns
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import quantile, upper_root
from calibgraph.solver.within_place import WEAK
from factors import ProjectionBlock
from factors.block_arrays import whiten

MIN_ROWS = 30  # fewer correspondences do not determine further unknowns
_MAX_ITERATIONS = 20
_CONVERGED = 1e-3  # largest change of an error in a step, in units of the loss' scale
_WEAK = 1e-4  # information of an unknown: nearly free, so that a few matches have an inverse
_LOSS_MEDIANS = 2.0 * 1.4826  # loss scale of 2 standard deviations, by the median of the errors


@dataclass(frozen=True, eq=False)
class Freed:
    """Some of the unknowns, fitted with the pose.

    Attributes:
        twist: (6,) of the pose: T_camera_lidar = exp(twist) estimate [rad, m].
        values: (m,) of the unknowns.
        covariance: (m, m) of these, by the scatter of the frames and what they share; NaN with one
            frame.
        compensating: (6, m) twists by which the pose makes up for a unit of each.
    """

    twist: Array
    values: Array
    covariance: Array
    compensating: Array

    @property
    def sigmas(self) -> Array:
        """(m,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class LinearFit:
    """The minimum with all unknowns free, and what the fits of fewer are made of.

    Attributes:
        values: (6 + k,) twist, and the unknowns.
        hessian: (6 + k, 6 + k), by the weights at the minimum.
        gradients: (f, 6 + k) of the frames, there.
        shared: variance of what all frames share, which their scatter does not show, over that of
            independent matches.
        considered: so many of the last unknowns are never estimated. They are zero give or take one
            standard deviation, which is their unit, and so widen the others.
    """

    values: Array
    hessian: Array
    gradients: Array
    shared: float
    considered: int = 0

    def counted_from(self, start: Array) -> LinearFit:
        """The same fit; the first unknowns were linearized at (k,) values."""
        rest = len(self.values) - 6 - len(start)
        return replace(self, values=self.values + np.pad(start, (6, rest)))

    def free(self, *unknowns: int) -> Freed:
        """The fit of the pose and some unknowns, with their numbers; the others are zero."""
        return self.free_each([unknowns])[0]

    def free_each(self, choices: Sequence[Sequence[int]]) -> list[Freed]:
        """The fits of several choices of as many unknowns: each as :meth:`free`."""
        rows = np.array([[*range(6), *(6 + number for number in each)] for each in choices])
        own, size = self.hessian[rows[:, :, None], rows[:, None]], rows.shape[1]
        diagonal = np.sqrt(np.maximum(np.einsum("fii->fi", own), 0.0))
        units = np.where(diagonal > 0, diagonal, 1.0)
        units = units[:, :, None] * units[:, None]
        inverse = np.linalg.inv(own / units) / units
        values = (inverse @ (self.hessian @ self.values)[rows, None])[:, :, 0]
        frames, pulls = len(self.gradients), self.gradients.T[rows]
        shown = pulls @ pulls.transpose(0, 2, 1)
        scatter = with_pseudo_frames(shown, own, np.full(size, float(frames)))
        scatter += _weak(size) if frames > 1 else np.nan
        follow = inverse @ self.hessian[rows, len(self.hessian) - self.considered :]
        whole = inverse @ scatter @ inverse + self.shared * inverse
        whole = (whole + follow @ follow.transpose(0, 2, 1))[:, 6:, 6:]
        compensating = -np.linalg.solve(own[:, :6, :6], own[:, :6, 6:])
        each = zip(values[:, :6], values[:, 6:], whole, compensating, strict=True)
        return [Freed(*parts) for parts in each]


def fit_camera(
    camera: Camera,
    block: CameraBlock,
    fields_px: Array,
    *,
    loss_scale: float | None = None,
    shared_variance: float = 0.0,
    considered: int = 0,
) -> LinearFit | None:
    """Fit pose and unknowns with a Cauchy loss on the norm of each match's error.

    Args:
        camera: lens, and the extrinsic about which is linearized.
        block: its matches.
        fields_px: (k, 2, n) derivatives of the pixels by the unknowns.
        loss_scale: of the whitened errors; None: from their median, which holds for up to about a
            third of outliers.
        shared_variance: of what all frames share, over that of all matches if these were
            independent.
        considered: see :class:`LinearFit`.

    Returns:
        The fit, or None of fewer than ``MIN_ROWS`` matches, or where it has no derivative.
    """
    if len(block) < MIN_ROWS:
        return None
    columns = _linearize(camera, block.block, fields_px)
    size, errors = len(columns) - 1, columns[-1].ravel()
    flat, values, left = columns[:-1].reshape(size, -1), np.zeros(size), errors.copy()
    weighted, weak = np.empty_like(flat), _weak(size)
    for _ in range(_MAX_ITERATIONS):
        squares = np.square(left.reshape(2, -1)).sum(axis=0)
        scale = loss_scale or _LOSS_MEDIANS * math.sqrt(quantile(squares, 0.5)) + 1e-12
        weights = np.tile(1.0 / (1.0 + squares / scale**2), 2)
        roots = np.sqrt(weights)
        np.multiply(flat, roots, out=weighted)
        hessian, before = weighted @ weighted.T + weak, values
        values = np.linalg.solve(hessian, weighted @ (roots * errors))
        change = (values - before) @ flat
        left -= change
        if np.abs(change).max() < _CONVERGED * scale:
            break
    if not np.isfinite(values).all():  # points where no derivative exists
        return None
    starts = block.frame_edges[:-1]
    pulls = np.add.reduceat(
        weighted * (roots * left), np.append(starts, starts + len(block)), axis=1
    )
    gradients = pulls.reshape(size, 2, -1).sum(axis=1).T
    variance = float(weights @ left**2 / weights.sum())
    return LinearFit(values, hessian, gradients, shared_variance * variance, considered)


def _linearize(camera: Camera, block: ProjectionBlock, fields_px: Array) -> Array:
    """(6 + k + 1, 2, n) whitened derivatives by a twist and the unknowns; last the errors."""
    columns = np.empty((7 + len(fields_px), 2, len(block)))
    pixels = fill_twist_columns(camera, block.points_lidar_m, columns[:6])
    columns[6:-1] = fields_px
    columns[-1] = camera.lens.subtract(block.pixels_px, pixels.T).T
    whiten(columns, block.sqrt_information)
    return columns


@cache
def _weak(size: int) -> Array:
    """(6 + k, 6 + k) information of a pose within sight and of unknowns that are nearly free."""
    return np.diag(np.append(np.diag(WEAK), np.full(size - 6, _WEAK)))


def block_of(camera: Camera, table: Correspondences) -> CameraBlock:
    """The rows of one camera, by frame, whitened by their information alone."""
    table = table.select(np.argsort(table.frame, kind="stable"))
    root = None if table.information_px is None else upper_root(table.information_px)
    block = ProjectionBlock(camera.lens, table.points_lidar_m, table.pixels_px, root)
    return CameraBlock(block, table.information_px, table.frame)
