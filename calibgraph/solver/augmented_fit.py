"""A robust fit of one camera's pose together with further unknowns, such as those of its lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.solver.camera_twist import project_with_jacobian
from calibgraph.solver.covariance import with_pseudo_frames

Array = NDArray[np.float64]

MIN_ROWS = 30  # fewer correspondences do not determine further unknowns
_MAX_ITERATIONS = 20
_CONVERGED = 1e-4  # largest change of an error in a step, in units of the loss' scale
_MIN_EIGENVALUE = 1e-10  # of a unit-diagonal matrix; smaller ones are rounding errors
_LOSS_SCALE = 2.0  # of the Cauchy loss, in units of the residuals' standard deviation


@dataclass(frozen=True, eq=False)
class AugmentedFit:
    """A pose with k further unknowns.

    Attributes:
        twist: (6,) rotation [rad] and translation [m] of T_camera_lidar = exp(twist) estimate.
        values: (k,) of the unknowns.
        sigmas: (k,) standard deviations by the scatter of the frames; NaN with one frame.
        independent_shares: (k,) share (0 to 1, root mean square) of an unknown's Jacobian that
            is independent of the pose and of the other unknowns. Near zero, the unknown is not
            observable.
    """

    twist: Array
    values: Array
    sigmas: Array
    independent_shares: Array


def fit_augmented(
    camera: Camera,
    table: Correspondences,
    jacobian_px: Array,
    *,
    loss_scale: float | None = None,
) -> AugmentedFit | None:
    """Fit pose and further unknowns robustly; the rows of one frame may share errors.

    Args:
        camera: lens, and the extrinsic about which the fit is linearised.
        table: the rows of this camera.
        jacobian_px: (n, 2, k) derivatives of each row's pixel by the unknowns.
        loss_scale: of the Cauchy loss, on errors times the root of their information; None: from
            their median, which holds for up to about a third of outliers.

    Returns:
        The fit, or None if the rows do not determine it.
    """
    if len(table) < MIN_ROWS:
        return None
    pixels, by_twist = project_with_jacobian(camera, table.points_lidar_m)
    whitening = _information_root(table)
    rows = whitening.transpose(0, 2, 1) @ np.concatenate([by_twist, jacobian_px], axis=2)
    targets = np.einsum("nij,ni->nj", whitening, table.pixels_px - pixels)
    solved = _solve_reweighted(rows, targets, loss_scale)
    if solved is None:
        return None
    solution, normal, weights = solved
    errors = rows @ solution - targets
    gradients = (weights[:, None, None] * rows * errors[:, :, None]).sum(axis=1)
    sigmas = _cluster_sigmas(normal, gradients, table.frame)
    shares = 1 / np.sqrt(np.diag(np.linalg.inv(normal)) * np.diag(normal))
    return AugmentedFit(solution[:6], solution[6:], sigmas[6:], shares[6:])


def compensating_twists(camera: Camera, table: Correspondences, jacobian_px: Array) -> Array:
    """(6, k) twists by which the pose compensates best for a unit of each unknown.

    By all rows alike, without a robust loss, with the camera at the solution. Arguments as of
    `fit_augmented`.
    """
    whitening = _information_root(table)
    by_twist, by_unknown = (
        (whitening.transpose(0, 2, 1) @ each).reshape(2 * len(table), -1)
        for each in (project_with_jacobian(camera, table.points_lidar_m)[1], jacobian_px)
    )
    return np.asarray(np.linalg.lstsq(by_twist, by_unknown)[0])


def _solve_reweighted(
    rows: Array, targets: Array, loss_scale: float | None
) -> tuple[Array, Array, Array] | None:
    """Iteratively reweighted least squares with a Cauchy loss on the norm of each row pair.

    Returns:
        (k,) solution; (k, k) normal matrix; (n,) weights. None if the matrix is singular.
    """
    flat, solution = rows.reshape(2 * len(rows), -1), np.zeros(rows.shape[2])
    for _ in range(_MAX_ITERATIONS):
        size = np.linalg.norm(rows @ solution - targets, axis=1)
        scale = loss_scale or _LOSS_SCALE * 1.4826 * np.median(size) + 1e-12
        weights = 1 / (1 + (size / scale) ** 2)
        weighted = flat * np.repeat(weights, 2)[:, None]
        normal = weighted.T @ flat
        if _is_singular(normal):
            return None
        before, solution = solution, np.linalg.solve(normal, weighted.T @ targets.reshape(-1))
        if np.abs(flat @ (solution - before)).max() < _CONVERGED * scale:
            break
    return solution, normal, weights


def _is_singular(normal: Array) -> bool:
    """Whether an unknown's column is nearly a combination of the others, whatever its unit."""
    units = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    return bool(np.linalg.eigvalsh(normal / np.outer(units, units))[0] < _MIN_EIGENVALUE)


def _information_root(table: Correspondences) -> Array:
    """(n, 2, 2) L with L L^T the information of each pixel."""
    if table.information_px is None:
        return np.tile(np.eye(2), (len(table), 1, 1))
    matrices = table.information_px[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(matrices)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root


def _cluster_sigmas(normal: Array, gradients: Array, frame: NDArray[np.int64]) -> Array:
    """Cluster-robust standard deviations of all unknowns, with frames as clusters."""
    frames, index = np.unique(frame, return_inverse=True)
    if len(frames) < 2:  # noqa: PLR2004
        return np.full(len(normal), np.nan)
    sums = np.zeros((len(frames), len(normal)))
    np.add.at(sums, index, gradients)
    count = np.full(len(normal), float(len(frames)))
    scatter = with_pseudo_frames(sums.T @ sums, normal, count)
    inverse = np.linalg.inv(normal)
    return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))
