"""One camera's correspondences, fitted with more unknowns than its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from calibgraph.solver.covariance import with_pseudo_frames

Array = NDArray[np.float64]

MIN_ROWS = 30  # fewer correspondences say nothing of further unknowns
_ITERATIONS = 20
_SETTLED = 1e-4  # of the loss' scale: what a further step would change errors by
_FREE = 1e-10  # eigenvalue of a unit-diagonal matrix that is rounding noise
_LOSS_SCALE = 2.0  # of the Cauchy loss, in units of the residuals' spread


@dataclass(frozen=True, eq=False)
class AugmentedFit:
    """A pose with k unknowns more.

    Attributes:
        twist: (6,) rotation [rad] and translation [m] of T_camera_lidar = exp(twist) estimate.
        values: (k,) of the unknowns.
        sigmas: (k,) standard deviations by the scatter of the frames; NaN with one frame.
        own_shares: (k,) which share (0 to 1, root mean square) of an unknown's column the pose
            and the other unknowns cannot imitate. Near zero, what is found of it says little.
    """

    twist: Array
    values: Array
    sigmas: Array
    own_shares: Array


def fit_augmented(
    camera: Camera,
    table: Correspondences,
    columns_px: Array,
    *,
    loss_scale: float | None = None,
) -> AugmentedFit | None:
    """Fit pose and further unknowns, robustly, with errors that the rows of one frame share.

    Args:
        camera: lens, and the pose about which everything is linear.
        table: the rows of this camera.
        columns_px: (n, 2, k) derivatives of each row's pixel by the unknowns.
        loss_scale: of the Cauchy loss, on errors times the root of their information; None: from
            their median, which does for up to about a third of outliers.

    Returns:
        The fit, or None if the rows do not determine it.
    """
    if len(table) < MIN_ROWS:
        return None
    pixels, flow = camera_flow(camera, table.points_lidar_m)
    columns = np.concatenate([flow, columns_px], axis=2)
    root = _information_root(table)
    rows = root.transpose(0, 2, 1) @ columns
    wanted = np.einsum("nij,ni->nj", root, table.pixels_px - pixels)
    flat, solution = rows.reshape(2 * len(rows), -1), np.zeros(columns.shape[2])
    for _ in range(_ITERATIONS):
        size = np.linalg.norm(rows @ solution - wanted, axis=1)
        scale = loss_scale or _LOSS_SCALE * 1.4826 * np.median(size) + 1e-12
        weights = 1 / (1 + (size / scale) ** 2)
        weighted = flat * np.repeat(weights, 2)[:, None]
        normal = weighted.T @ flat
        if _is_singular(normal):
            return None
        before, solution = solution, np.linalg.solve(normal, weighted.T @ wanted.reshape(-1))
        if np.abs(flat @ (solution - before)).max() < _SETTLED * scale:
            break
    errors = rows @ solution - wanted
    gradients = (weights[:, None, None] * rows * errors[:, :, None]).sum(axis=1)
    sigmas = _cluster_sigmas(normal, gradients, table.frame)
    own_shares = 1 / np.sqrt(np.diag(np.linalg.inv(normal)) * np.diag(normal))
    return AugmentedFit(solution[:6], solution[6:], sigmas[6:], own_shares[6:])


def imitation(camera: Camera, table: Correspondences, columns_px: Array) -> Array:
    """(6, k) twists by which the pose makes up best for a unit of each unknown that is ignored.

    By all rows alike, the camera's pose being the solution. Arguments as of `fit_augmented`.
    """
    root = _information_root(table)
    flow, columns = (
        (root.transpose(0, 2, 1) @ each).reshape(2 * len(table), -1)
        for each in (camera_flow(camera, table.points_lidar_m)[1], columns_px)
    )
    return np.asarray(np.linalg.lstsq(flow, columns)[0])


def camera_flow(camera: Camera, points_lidar_m: Array) -> tuple[Array, Array]:
    """(n, 2) pixels of points, and (n, 2, 6) their derivatives by a twist of T_camera_lidar."""
    T = camera.T_camera_lidar
    points = points_lidar_m @ T[:3, :3].T + T[:3, 3]
    pixels, by_point = camera.lens.project_with_jacobian(points)
    x, y, z = points.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    return pixels, np.concatenate([by_point @ cross, by_point], axis=2)


def moved_by(camera: Camera, twist: Array) -> Camera:
    """The camera at exp(twist) of its pose; to first order in the translation."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    T[:3, 3] = twist[3:]
    return camera.moved_to(T @ camera.T_camera_lidar)


def _is_singular(normal: Array) -> bool:
    """Whether a column is (nearly) made up of the others, in units in which all are alike."""
    units = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    return bool(np.linalg.eigvalsh(normal / np.outer(units, units))[0] < _FREE)


def _information_root(table: Correspondences) -> Array:
    """(n, 2, 2) L with L L^T the information of each pixel."""
    if table.information_px is None:
        return np.tile(np.eye(2), (len(table), 1, 1))
    matrices = table.information_px[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    values, vectors = np.linalg.eigh(matrices)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    return root


def _cluster_sigmas(normal: Array, gradients: Array, frame: NDArray[np.int64]) -> Array:
    """Standard deviations of all unknowns from the scatter of the frames' gradients."""
    frames, index = np.unique(frame, return_inverse=True)
    if len(frames) < 2:  # noqa: PLR2004
        return np.full(len(normal), np.nan)
    sums = np.zeros((len(frames), len(normal)))
    np.add.at(sums, index, gradients)
    count = np.full(len(normal), float(len(frames)))
    scatter = with_pseudo_frames(sums.T @ sums, normal, count)
    inverse = np.linalg.inv(normal)
    return np.asarray(np.sqrt(np.diag(inverse @ scatter @ inverse)))
