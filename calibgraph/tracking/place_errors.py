"""The error model of ``calibgraph.graph.latent_poses`` for sums over places, in closed form.

Near the references everything is a quadratic, so all poses that places have of their own are
eliminated by formula. Of camera c at place p, let H = L L^T be the Hessian of its F frames and b
the gradient. What it shows of the pose is -H^-1 b, with the covariance

    V = L^-T (W + q F) L^-1            W: by the scatter of frames, in units of H; q: of one place

All cameras of a place are tied by the cloud's displacement there (covariance D, by the adjoints A):
V + A D A^T. The information of places adds to that of the poses as matches show them everywhere;
these differ from the poses by C per camera, by the bends of the cloud, and by its displacement
everywhere (K). Of the bends, what is usual and what the residuals show make a mean and a
covariance: the mean displaces the poses that matches show, the covariance is part of their error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import adjoint_camera_lidar
from calibgraph.solver.variance_components import VarianceRatios
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.bends import BendSums
from calibgraph.tracking.place_sums import PlaceSums

Array = NDArray[np.float64]

_LEAST_SIGMA = 1e-5  # rad and m, as of the batch
_EXACT = 100.0 * _LEAST_SIGMA**2  # what is stated to be so, of any size
_LEAST_VARIANCE = 0.1  # of independent matches


@dataclass(frozen=True, eq=False)
class SharedErrors:
    """Covariances of what frames have in common, at given poses.

    Attributes:
        cloud: (6, 6) K, in the LiDAR frame.
        camera: (6, 6) C, in the camera's axes.
        bends: (n, 6, 3) how each camera's matches follow a unit of each bend.
        bend_covariance: (3, 3) of the bends.
        bend_mean: (3,) of the bends.
        cloud_at_place: (6, 6) D, in the LiDAR frame.
        place_variance: q.
        cameras_size: by which what a camera's frames share at a place is larger than usual.
        to_cameras: (n, 6, 6) A, from a motion of the cloud to that of each camera.
    """

    cloud: Array
    camera: Array
    bends: Array
    bend_covariance: Array
    bend_mean: Array
    cloud_at_place: Array
    place_variance: float
    cameras_size: float
    to_cameras: Array

    @staticmethod
    def of(
        findings: MatcherFindings,
        T_lidar_camera: Sequence[gtsam.Pose3],
        sizes: VarianceRatios,
        bend_shifts: Array,
    ) -> SharedErrors:
        """What a matcher states, times the sizes that the data show, about these poses.

        Args:
            findings: of the matcher.
            T_lidar_camera: per camera.
            sizes: of the errors over what is stated.
            bend_shifts: (n, 6, 3), see :class:`calibgraph.tracking.bends.BendSums`.
        """
        of_bends = np.square(findings.bend_sigmas)
        whole = np.square(findings.rigid_sigmas)
        at_place = np.square([findings.place_rotation_rad, findings.place_translation_m])
        return SharedErrors(
            cloud=sizes.shared * _covariance((1.0 - findings.camera_share) * whole),
            camera=sizes.shared * _covariance(findings.camera_share * whole),
            bends=bend_shifts,
            bend_covariance=sizes.shared * np.diag(of_bends),
            bend_mean=np.zeros(len(of_bends)),
            cloud_at_place=sizes.cloud * _covariance(at_place),
            place_variance=findings.place_variance,
            cameras_size=sizes.cameras,
            to_cameras=np.array([*map(adjoint_camera_lidar, T_lidar_camera)]),
        )

    def with_residuals(self, bends: BendSums, variance: Array) -> SharedErrors:
        """With what the residuals show of the bends, about which only what is usual was known.

        Args:
            bends: of all epochs.
            variance: (n,) of each camera's matches, over that of independent ones.
        """
        information = (bends.information / variance[:, None, None]).sum(axis=0)
        vector = (bends.vector / variance[:, None]).sum(axis=0)
        less = np.eye(len(vector)) + self.bend_covariance @ information
        covariance = np.asarray(np.linalg.solve(less, self.bend_covariance), dtype=np.float64)
        return replace(self, bend_covariance=covariance, bend_mean=covariance @ vector)

    @cached_property
    def cameras(self) -> Array:
        """(6 n, 6 n) of the cameras as matches show them everywhere: C, and the bends."""
        flat, n = self.bends.reshape(-1, self.bends.shape[2]), len(self.bends)
        of_bends = flat @ self.bend_covariance @ flat.T
        return np.asarray(np.kron(np.eye(n), self.camera) + of_bends)

    @property
    def offset(self) -> Array:
        """(6 n,) step from the cameras to how matches show them everywhere, by the bends' mean."""
        return np.asarray(self.bends @ self.bend_mean).ravel()

    @cached_property
    def everywhere(self) -> Array:
        """(6 n, 6 n) of what all frames share, in the cameras' axes: C, the bends, and K."""
        flat = self.to_cameras.reshape(-1, 6)
        return np.asarray(self.cameras + flat @ self.cloud @ flat.T)

    @property
    def are_at_places(self) -> bool:
        """Whether frames of one place share more than all frames do."""
        return bool(self.place_variance > 0 or (np.diag(self.cloud_at_place) > _EXACT).any())


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
        both = np.column_stack([self.matrix, self.vector - self.matrix @ errors.offset])
        found = np.asarray(np.linalg.solve(widened, both), dtype=np.float64)
        matrix = found[:, :-1]
        return Information((matrix + matrix.T) / 2, found[:, -1])


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

    @property
    def least(self) -> Array:
        """(n,) the variance that matches keep for themselves, as in a batch."""
        return np.clip(np.linalg.eigvalsh(self.spread)[:, 0], _LEAST_VARIANCE, 1.0)

    def mean_variance(self, sums: PlaceSums, place_variance: float) -> Array:
        """(n,) of all matches of each camera, over that of independent ones, as in a batch.

        In the mean over the directions of a pose; infinite without frames.

        Args:
            sums: of the frames.
            place_variance: q.
        """
        inverse = np.linalg.inv(self.root)
        whole = self.spread + place_variance * sums.alike[:, None, None] * np.eye(6)
        variance = np.einsum("nji,njk,nki->n", inverse, whole, inverse) / 6
        return np.where(sums.frames.any(axis=0), variance, np.inf)


@dataclass(frozen=True, eq=False)
class PlaceTerms:
    """What the matches of each camera at some places show.

    Attributes:
        root: (P, n, 6, 6) L.
        excess: (P, n, 6, 6) what L^T V L has beyond the noise of independent matches.
        own: (P, n, 6, 6) inverse of V; 0 where a camera has no frames.
        vector: (P, n, 6) the same times -H^-1 b.
        cloud: (P, 6, 6) D.
        left: (P, 6, 6) covariance of the cloud's displacement at a place, the cameras' poses given.
        to_cameras: (n, 6, 6) A.
    """

    root: Array
    excess: Array
    own: Array
    vector: Array
    cloud: Array
    left: Array
    to_cameras: Array

    @staticmethod
    def of(
        sums: PlaceSums, rows: NDArray[np.bool_], seen: FrameSpread, errors: SharedErrors
    ) -> PlaceTerms:
        """At some places.

        Args:
            sums: of all frames.
            rows: (P,) which places.
            seen: by the frames of each camera.
            errors: what frames share.
        """
        frames, places = sums.frames[rows], sums.places[rows]
        root = np.linalg.cholesky(sums.reweighted[rows] + WEAK) @ seen.root
        shared = errors.place_variance * frames / places
        noise = seen.least[:, None, None] * np.eye(6)
        excess = seen.spread - noise + shared[..., None, None] * np.eye(6)
        excess = errors.cameras_size * excess
        half = root @ np.linalg.inv(noise + excess)
        own = half @ root.swapaxes(2, 3) * (frames > 0)[..., None, None]
        whitened = np.linalg.solve(root, -sums.gradient[rows][..., None])
        vector = (half @ whitened)[..., 0] * (frames > 0)[..., None]
        A = errors.to_cameras
        of_cloud = (A.swapaxes(1, 2) @ own @ A).sum(axis=1)
        alike = np.where(frames > 0, places, np.inf).min(axis=1)
        alike = np.where(np.isfinite(alike), alike, 1.0)
        cloud = errors.cloud_at_place / alike[:, None, None]
        left = np.linalg.solve(np.eye(6) + cloud @ of_cloud, cloud)
        return PlaceTerms(root, excess, own, vector, cloud, left, A)

    @property
    def information(self) -> Information:
        """Of each place about all cameras, (P, 6 n, 6 n): the cloud's displacement eliminated."""
        P, n = self.own.shape[:2]
        flat = (self.own @ self.to_cameras).reshape(P, 6 * n, 6)
        pull = np.einsum("nji,pnj->pi", self.to_cameras, self.vector)
        matrix = -flat @ self.left @ flat.swapaxes(1, 2)
        blocks = matrix.reshape(P, n, 6, n, 6)
        blocks[:, np.arange(n), :, np.arange(n)] += self.own.swapaxes(0, 1)
        less = (flat @ (self.left @ pull[..., None]))[..., 0]
        return Information(matrix, self.vector.reshape(P, 6 * n) - less)


def root_of(reweighted: Array, true: Array) -> Array:
    """(6, 6) of :class:`FrameSpread`, from both Hessians, the true one positive definite."""
    outer = np.asarray(np.linalg.cholesky(reweighted + WEAK), dtype=np.float64)
    return np.asarray(np.linalg.cholesky(whiten(outer, true + WEAK)))


def whiten(root: Array, matrix: Array) -> Array:
    """(6, 6) R^-1 M R^-T of a symmetric M."""
    found = np.linalg.solve(root, np.linalg.solve(root, matrix).T)
    return np.asarray((found + found.T) / 2)


def spread_over(scatter: Array, reweighted: Array, root: Array) -> Array:
    """(6, 6) W: a scatter of frames' gradients in units of independent matches."""
    outer = np.asarray(np.linalg.cholesky(reweighted + WEAK), dtype=np.float64)
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
    of_frame = errors.place_variance * np.linalg.inv(frame_hessian + WEAK)
    for camera in range(n):
        rows = slice(6 * camera, 6 * camera + 6)
        found[rows, rows] += both[camera, camera] * of_frame[camera]
    return np.asarray(found)
