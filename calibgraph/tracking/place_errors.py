"""The error model of ``calibgraph.solver.hierarchy`` for sums over places, in closed form.

Near the references everything is a quadratic, so all poses that places have of their own are
eliminated by formula. Of camera c at place p, let H = L L^T be the Hessian of its F frames and b
the gradient. What it shows of the pose is -H^-1 b, with the covariance

    V = L^-T (W + q F) L^-1            W: by the scatter of frames, in units of H; q: of one place

All cameras of a place are tied by the cloud's displacement there (covariance D, by the adjoints A):
V + A D A^T. The information of places adds to that of the poses as matches show them everywhere;
these differ from the poses by C per camera, and by the cloud's displacement everywhere (K).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import adjoint_camera_lidar
from calibgraph.tracking.place_sums import PlaceSums
from factors import pose_sigmas

Array = NDArray[np.float64]

_LEAST_SIGMA = 1e-5  # rad and m, as of the batch
_WEAK = np.diag(pose_sigmas(rotation_rad=1.0, translation_m=10.0) ** -2.0)
"""Information of a pose within sight, so that few matches have an inverse."""


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Covariances of what frames have in common, at given poses.

    Attributes:
        everywhere: (6 n, 6 n) of what all frames share, in the cameras' axes: C and K.
        cloud_at_place: (6, 6) D, in the LiDAR frame.
        place_variance: q.
        to_cameras: (n, 6, 6) A, from a motion of the cloud to that of each camera.
    """

    everywhere: Array
    cloud_at_place: Array
    place_variance: float
    to_cameras: Array

    @staticmethod
    def of(findings: MatcherFindings, T_lidar_camera: Sequence[gtsam.Pose3]) -> SharedErrors:
        """The sizes that a matcher states, about these poses."""
        to_cameras = np.array([*map(adjoint_camera_lidar, T_lidar_camera)])
        n, whole = len(to_cameras), np.square(findings.systematic_sigmas)
        at_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
        flat = to_cameras.reshape(6 * n, 6)
        cloud = _covariance((1.0 - findings.camera_share) * whole)
        cameras = np.kron(np.eye(n), _covariance(findings.camera_share * whole))
        return SharedErrors(
            cameras + flat @ cloud @ flat.T,
            _covariance(at_place),
            findings.place_variance,
            to_cameras,
        )

    @property
    def are_at_places(self) -> bool:
        """Whether frames of one place share more than all frames do."""
        return self.place_variance > 0 or self.cloud_at_place[0, 0] > _LEAST_SIGMA**2


def _covariance(variances: Array) -> Array:
    """(6, 6) from the variance [rad^2] and [m^2] per axis."""
    return np.diag(np.maximum(np.repeat(variances, 3), _LEAST_SIGMA**2))


@dataclass(frozen=True, eq=False)
class Information:
    """Quadratics in all cameras' steps from the references, as matches show them everywhere.

    Attributes:
        matrix: (..., 6 n, 6 n).
        vector: (..., 6 n) the matrix times the step to the minimum.
    """

    matrix: Array
    vector: Array

    def sum(self, rows: NDArray[np.bool_]) -> Information:
        """The sum of some rows."""
        return Information(self.matrix[rows].sum(axis=0), self.vector[rows].sum(axis=0))

    def __add__(self, other: Information) -> Information:
        return Information(self.matrix + other.matrix, self.vector + other.vector)

    def of_cameras(self, errors: SharedErrors) -> Information:
        """Of the poses themselves: less what all frames share."""
        widened = np.eye(len(self.matrix)) + self.matrix @ errors.everywhere
        both = np.column_stack([self.matrix, self.vector])
        found = np.asarray(np.linalg.solve(widened, both), dtype=np.float64)
        matrix = found[:, :-1]
        return Information((matrix + matrix.T) / 2, found[:, -1])


def information_of_places(
    sums: PlaceSums, rows: NDArray[np.bool_], seen: FrameSpread, errors: SharedErrors
) -> Information:
    """The information of each of some places.

    Args:
        sums: of all frames.
        rows: (P,) which places.
        seen: by the frames of each camera.
        errors: what frames share.
    """
    gradient = sums.gradient[rows]
    frames, places = sums.frames[rows], sums.places[rows]
    P, n = frames.shape
    root = np.linalg.cholesky(sums.reweighted[rows] + _WEAK) @ seen.root
    shared = errors.place_variance * frames / places
    inner = np.linalg.inv(seen.spread + shared[..., None, None] * np.eye(6))
    half = root @ inner
    own = half @ root.swapaxes(2, 3) * (frames > 0)[..., None, None]
    whitened = np.linalg.solve(root, -gradient[..., None])
    vector = (half @ whitened)[..., 0] * (frames > 0)[..., None]
    by_cloud = own @ errors.to_cameras  # (P, n, 6, 6)
    turned = errors.to_cameras.swapaxes(1, 2)
    of_cloud = (turned @ by_cloud).sum(axis=1)
    pull = np.einsum("nij,pnj->pi", turned, vector)
    alike = np.where(frames > 0, places, np.inf).min(axis=1)
    cloud = errors.cloud_at_place / np.where(np.isfinite(alike), alike, 1.0)[:, None, None]
    left = np.linalg.solve(np.eye(6) + cloud @ of_cloud, cloud)
    flat = by_cloud.reshape(P, 6 * n, 6)
    matrix = -flat @ left @ flat.swapaxes(1, 2)
    blocks = matrix.reshape(P, n, 6, n, 6)
    blocks[:, np.arange(n), :, np.arange(n)] += own.swapaxes(0, 1)
    less = (flat @ (left @ pull[..., None]))[..., 0]
    return Information(matrix, vector.reshape(P, 6 * n) - less)


@dataclass(frozen=True, eq=False)
class FrameSpread:
    """What the frames of each camera show of their errors, in units of the reweighted Hessian.

    Attributes:
        root: (n, 6, 6) Cholesky root of the true Hessian, as seen from that of the reweighted one:
            the sums over a place are too few for a true Hessian of its own.
        spread: (n, 6, 6) W, in units of the true Hessian.
    """

    root: Array
    spread: Array


def root_of(reweighted: Array, true: Array) -> Array:
    """(6, 6) of :class:`FrameSpread`, from both Hessians, the true one positive definite."""
    outer = np.asarray(np.linalg.cholesky(reweighted + _WEAK), dtype=np.float64)
    return np.asarray(np.linalg.cholesky(whiten(outer, true + _WEAK)))


def whiten(root: Array, matrix: Array) -> Array:
    """(6, 6) R^-1 M R^-T of a symmetric M."""
    found = np.linalg.solve(root, np.linalg.solve(root, matrix).T)
    return np.asarray((found + found.T) / 2)


def spread_over(scatter: Array, reweighted: Array, root: Array) -> Array:
    """(6, 6) W: a scatter of frames' gradients in units of independent matches."""
    outer = np.asarray(np.linalg.cholesky(reweighted + _WEAK), dtype=np.float64)
    return whiten(outer @ root, scatter)


def shift_covariance(
    before: Array, after: Array, frame_hessian: Array, errors: SharedErrors
) -> Array:
    """(6 n, 6 n) covariance of the steps between two sets of frames by what places share.

    Frames of the same place share their errors, which cancel.

    Args:
        before: (P, n) numbers of frames of the first set, per place and camera.
        after: (P, n) of the second.
        frame_hessian: (n, 6, 6) of one frame.
        errors: what frames share.
    """
    apart = before / np.maximum(before.sum(axis=0), 1.0)
    apart = apart - after / np.maximum(after.sum(axis=0), 1.0)
    both = apart.T @ apart
    n = len(both)
    flat = errors.to_cameras.reshape(6 * n, 6)
    found = np.kron(both, np.ones((6, 6))) * (flat @ errors.cloud_at_place @ flat.T)
    of_frame = errors.place_variance * np.linalg.inv(frame_hessian + _WEAK)
    for camera in range(n):
        rows = slice(6 * camera, 6 * camera + 6)
        found[rows, rows] += both[camera, camera] * of_frame[camera]
    return np.asarray(found)
