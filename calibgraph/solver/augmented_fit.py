"""A robust fit of one camera's pose together with further unknowns, such as those of its lens."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_twist import fill_twist_columns
from calibgraph.solver.covariance import with_pseudo_frames
from calibgraph.solver.normal_kernel import (
    grouped_gradients,
    solve_reweighted,
    weighted_products,
)
from calibgraph.solver.whitening import upper_root
from factors import ProjectionBlock, unit_diagonal

Array = NDArray[np.float64]

MIN_ROWS = 30  # fewer correspondences do not determine further unknowns
_MAX_ITERATIONS = 20
_CONVERGED = 1e-4  # largest change of an error in a step, in units of the loss' scale
_LEAST_SHARE = 1e-10  # of an unknown's column, squared; smaller ones are rounding errors
_LOSS_MEDIANS = 2.0 * 1.4826  # loss scale of 2 standard deviations, by the median of the errors


@dataclass(frozen=True, eq=False)
class AugmentedFit:
    """A pose with k further unknowns.

    Attributes:
        twist: (6,) rotation [rad] and translation [m] of T_camera_lidar = exp(twist) estimate.
        values: (k,) of the unknowns.
        sigmas: (k,) standard deviations, by the scatter of the frames and what they share; NaN with
            one frame.
        independent_shares: (k,) share (0 to 1, root mean square) of an unknown's Jacobian that
            is independent of the pose and of the other unknowns. Near zero, the unknown is not
            observable.
        compensating: (6, k) twists by which the pose compensates for a unit of each unknown.
    """

    twist: Array
    values: Array
    sigmas: Array
    independent_shares: Array
    compensating: Array


@dataclass(frozen=True, eq=False)
class LinearRows:
    """Errors of one camera's correspondences as linear functions of its pose and more unknowns.

    Made once, it is fitted with one choice of unknowns after the other.

    Attributes:
        columns: (6 + k + 1, 2, n) whitened derivatives of the pixels by a twist of the pose and by
            the unknowns; the last are the whitened errors, observed minus predicted.
        group: (n,) which of the frames each row is of; the rows of one frame may share errors.
        groups: how many frames.
    """

    columns: Array
    group: NDArray[np.int64]
    groups: int

    def fit(
        self,
        unknowns: Sequence[int],
        *,
        loss_scale: float | None = None,
        shared_variance: float = 0.0,
    ) -> AugmentedFit | None:
        """Fit the pose and some of the unknowns robustly; see :func:`fit_augmented`.

        Args:
            unknowns: their numbers, from 0.
            loss_scale: of the Cauchy loss.
            shared_variance: of what all frames share, which their scatter does not show: times the
                covariance of all rows, if they were independent.
        """
        if len(self.group) < MIN_ROWS:
            return None
        which = np.array([*range(6), *(6 + k for k in unknowns), len(self.columns) - 1])
        limits = (_MAX_ITERATIONS, _CONVERGED, _LEAST_SHARE)
        solved = solve_reweighted(self.columns, which, loss_scale, _LOSS_MEDIANS, limits)
        if solved is None:
            return None
        solution, normal, weights, errors = solved
        inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        sigmas = self._cluster_sigmas(which[:-1], normal, inverse, weights, errors)
        variance = (weights * (errors**2).sum(axis=0)).sum() / (2 * weights.sum())
        sigmas = np.sqrt(sigmas**2 + shared_variance * variance * np.diag(inverse))
        shares = 1 / np.sqrt(np.diag(inverse) * np.diag(normal))
        compensating = np.asarray(-np.linalg.solve(normal[:6, :6], normal[:6, 6:]))
        return AugmentedFit(solution[:6], solution[6:], sigmas[6:], shares[6:], compensating)

    def compensating_twists(self, unknowns: Sequence[int], weights: Array) -> Array:
        """(6, k) twists by which the pose compensates best for a unit of each unknown.

        Args:
            unknowns: their numbers, from 0.
            weights: (n,) of the rows.

        Returns:
            (6, k); NaN where the rows do not determine the pose, as without any.
        """
        which = np.array([*range(6), *(6 + k for k in unknowns)])
        products = weighted_products(self.columns, which, weights)
        scaled, units = unit_diagonal(products[:6, :6])
        if np.linalg.matrix_rank(scaled, hermitian=True) < len(scaled):
            return np.full((6, len(unknowns)), np.nan)
        twists = np.linalg.solve(scaled, products[:6, 6:] / units[:, None])
        return np.asarray(twists / units[:, None])

    def _cluster_sigmas(
        self, which: NDArray[np.intp], normal: Array, inverse: Array, weights: Array, errors: Array
    ) -> Array:
        """Cluster-robust standard deviations of all unknowns, with frames as clusters.

        Args:
            which: (k,) columns.
            normal: (k, k).
            inverse: (k, k) of it.
            weights: (n,).
            errors: (2, n).
        """
        if self.groups < 2:  # noqa: PLR2004
            return np.full(len(normal), np.nan)
        sums = grouped_gradients(self.columns, which, errors, weights, self.group, self.groups)
        scatter = with_pseudo_frames(
            sums.T @ sums, normal, np.full(len(normal), float(self.groups))
        )
        return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))


def linearize(camera: Camera, table: Correspondences, jacobian_px: Array) -> LinearRows:
    """The rows of a fit of the pose together with further unknowns.

    Args:
        camera: lens, and the extrinsic about which is linearised.
        table: the rows of this camera.
        jacobian_px: (n, 2, k) derivatives of each row's pixel by the unknowns.
    """
    numbers, group = np.unique(table.frame, return_inverse=True)
    root = None if table.information_px is None else upper_root(table.information_px)
    block = ProjectionBlock(camera.lens, table.points_lidar_m, table.pixels_px, root)
    columns = np.empty((6 + jacobian_px.shape[2] + 1, 2, len(table)))
    columns[6:-1] = jacobian_px.transpose(2, 1, 0)
    _finish_columns(columns, _fill_pose(columns, camera, block), camera, block)
    return LinearRows(columns, group, len(numbers))


def linearize_block(
    camera: Camera, block: CameraBlock, unknowns: int, fill: Callable[[Array, Array], None]
) -> LinearRows:
    """As :func:`linearize`, of correspondences with their weights.

    Args:
        camera: as there.
        block: its correspondences.
        unknowns: k.
        fill: given the (2, n) predicted pixels, fills (k, 2, n) derivatives by the unknowns.
    """
    columns = np.empty((6 + unknowns + 1, 2, len(block)))  # filled in place: fresh memory is slow
    pixels = _fill_pose(columns, camera, block.block)
    fill(pixels, columns[6:-1])
    _finish_columns(columns, pixels, camera, block.block)
    group = np.repeat(np.arange(block.frames), np.diff(block.frame_edges))
    return LinearRows(columns, group, block.frames)


def _fill_pose(columns: Array, camera: Camera, block: ProjectionBlock) -> Array:
    """Fill in the derivatives by the pose; (2, n) predicted pixels."""
    return fill_twist_columns(camera, block.points_lidar_m, columns[:6])


def _finish_columns(columns: Array, pixels: Array, camera: Camera, block: ProjectionBlock) -> None:
    """Fill in the errors, and whiten all columns."""
    columns[-1] = camera.lens.subtract(block.pixels_px, pixels.T).T
    if block.sqrt_information is None:
        return
    s00, s01, s11 = block.sqrt_information.T
    columns[:, 0] *= s00
    if s01.any():
        columns[:, 0] += s01 * columns[:, 1]
    columns[:, 1] *= s11


def fit_augmented(
    camera: Camera,
    table: Correspondences,
    jacobian_px: Array,
    *,
    loss_scale: float | None = None,
    shared_variance: float = 0.0,
) -> AugmentedFit | None:
    """Fit pose and further unknowns robustly; the rows of one frame may share errors.

    Args:
        camera: lens, and the extrinsic about which the fit is linearised.
        table: the rows of this camera.
        jacobian_px: (n, 2, k) derivatives of each row's pixel by the unknowns.
        loss_scale: of the Cauchy loss, on errors times the root of their information; None: from
            their median, which holds for up to about a third of outliers.
        shared_variance: see :meth:`LinearRows.fit`.

    Returns:
        The fit, or None if the rows do not determine it.
    """
    if len(table) < MIN_ROWS:
        return None
    rows = linearize(camera, table, jacobian_px)
    unknowns = range(jacobian_px.shape[2])
    return rows.fit(unknowns, loss_scale=loss_scale, shared_variance=shared_variance)


def compensating_twists(camera: Camera, table: Correspondences, jacobian_px: Array) -> Array:
    """(6, k) twists by which the pose compensates best for a unit of each unknown.

    By all rows alike, without a robust loss, with the camera at the solution. Arguments as of
    `fit_augmented`.
    """
    rows = linearize(camera, table, jacobian_px)
    return rows.compensating_twists(range(jacobian_px.shape[2]), np.ones(len(table)))
