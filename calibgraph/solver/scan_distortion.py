"""Scan distortion: errors of the cloud that no rigid motion describes, as each camera sees them.

A rigid motion of the cloud moves all cameras alike. Three errors of recorded sensors do not: beams
that all point higher or lower than is stated, which pitch the cloud along every line of sight;
beams that are spread too far or too little; and motion during a turn, which displaces each
heading by another amount. Each is one unknown number of the whole rig; it displaces a camera's
matches by an amount that depends on their points. The part that no pose can follow remains in the
residuals and measures the distortion: informative for a panoramic camera, weak for a narrow one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.graph.by_place import place_of
from calibgraph.graph.lens import LensVariable
from calibgraph.model.geometry import adjoints, to_T_camera_lidar
from calibgraph.model.rig import Camera
from calibgraph.solver.matches import CameraBlock
from calibgraph.solver.robust import ResidualScale
from factors import FreeLensBlock, ProjectionBlock
from factors.block_arrays import whiten

Numbers = NDArray[np.int64]

_DISTORTIONS = 3
_SAMPLE = 4000  # correspondences: they know the displacement to some 1 % of its size


def distortions_at(points_lidar_m: Array) -> Array:
    """(3, n, 3) displacements in the LiDAR frame, by a unit of each distortion.

    Elevations that are all a radian higher; elevations twice as far from the horizon; a metre of
    motion. The motion is ahead, over a turn that begins and ends behind: a point straight ahead is
    where it is reported, one behind is half of it off.

    Args:
        points_lidar_m: (n, 3).
    """
    x, y, z = points_lidar_m.T
    level, heading = np.hypot(x, y), np.arctan2(y, x)
    elevation = np.column_stack([-z * np.cos(heading), -z * np.sin(heading), level])
    motion = np.zeros_like(points_lidar_m)
    motion[:, 0] = heading / (2 * np.pi)
    stretch = elevation * np.arctan2(z, level)[:, None]
    return np.stack([elevation, stretch, motion])


def distortion_fields_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(3, 2, n) derivatives of the pixels of points (n, 3) by a unit of each distortion."""
    T = camera.T_camera_lidar
    _, by_point = camera.lens.project_with_jacobian(points_lidar_m @ T[:3, :3].T + T[:3, 3])
    moved = distortions_at(points_lidar_m) @ T[:3, :3].T
    return np.asarray(np.einsum("nij,knj->kin", by_point, moved))


@dataclass(frozen=True, eq=False)
class DistortionEvidence:
    """Quadratics of a camera's matches in the distortions.

    Near the minimum half the squared residuals are those of a pose that has moved by ``jacobian``
    times the distortions, plus the quadratics of ``information`` and ``vector``.

    Attributes:
        jacobian: (6, 3) displacement of their pose by a unit of each distortion.
        hessian: (6, 6) J^T J of all matches plus the weak prior: the weight of ``jacobian`` in a
            mean over several sets of matches.
        information: (P, 3, 3) of the residuals at each place, if all matches were independent.
        vector: (P, 3) the information times the distortions that the residuals show.
        lens_jacobian: (k, 3) displacement of a free lens, likewise; of a fixed one, (0, 3).
    """

    jacobian: Array
    hessian: Array
    information: Array
    vector: Array
    lens_jacobian: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @staticmethod
    def none(weak: Array, *, places: int) -> DistortionEvidence:
        """No matches, with the weak prior alone."""
        jacobian = np.zeros((len(weak), _DISTORTIONS))
        information = np.zeros((places, _DISTORTIONS, _DISTORTIONS))
        return DistortionEvidence(jacobian, weak, information, np.zeros((places, _DISTORTIONS)))

    def as_of_one_place(self) -> DistortionEvidence:
        """The sum over places."""
        information, vector = self.information.sum(axis=0), self.vector.sum(axis=0)
        return replace(self, information=information[None], vector=vector[None])

    def __add__(self, other: DistortionEvidence) -> DistortionEvidence:
        """Both sets of matches of as many places, of cameras with known lenses."""
        hessian = self.hessian + other.hessian
        pulled = self.hessian @ self.jacobian + other.hessian @ other.jacobian
        return DistortionEvidence(
            np.asarray(np.linalg.solve(hessian, pulled), dtype=np.float64),
            hessian,
            self.information + other.information,
            self.vector + other.vector,
        )


def distortion_evidence(
    block: CameraBlock,
    scale: ResidualScale,
    T_lidar_camera: gtsam.Pose3,
    weak: Array,
    *,
    places: Sequence[Numbers],
    lens: LensVariable | None = None,
) -> DistortionEvidence:
    """The quadratics of a camera's matches, in the tangent of ``T_lidar_camera``.

    With J and K the Jacobians of the whitened residuals by pose and distortions, the pose follows
    by -(J^T J)^-1 J^T K. At each place K is reduced by what a pose of that place can follow, so
    that a displaced place shows no distortion.

    Args:
        block: inliers of one camera.
        scale: of their residuals.
        T_lidar_camera: their minimum.
        weak: (6 + k, 6 + k) information that is added to J^T J, so that few matches have an
            inverse.
        places: the numbers of the frames of each place.
        lens: of the camera, if it is free; it follows as the pose does.
    """
    some = block.select_evenly(_SAMPLE)
    share = len(some) / len(block)
    place = place_of(some.frame, places)
    order = np.argsort(place, kind="stable")
    rows = some.block.select(order)
    by_pose, by_distortion, residuals = _jacobians(rows, scale, T_lidar_camera)
    if lens is not None:
        by_pose = np.hstack([by_pose, _by_lens(rows, scale, T_lidar_camera, lens)])
    weak = share * weak
    size = by_distortion.shape[1]
    information, vector = np.zeros((len(places), size, size)), np.zeros((len(places), size))
    edges = 2 * np.searchsorted(place[order], np.arange(len(places) + 1))
    for number in np.flatnonzero(np.diff(edges)):
        own = slice(edges[number], edges[number + 1])
        left = by_distortion[own] + by_pose[own] @ _follow(by_pose[own], by_distortion[own], weak)
        information[number] = left.T @ left / share
        vector[number] = left.T @ residuals[own] / share
    hessian = (by_pose.T @ by_pose + weak)[:6, :6] / share
    follow = _follow(by_pose, by_distortion, weak)
    return DistortionEvidence(follow[:6], hessian, information, vector, follow[6:])


def pair_jacobians(
    jacobians: Array,
    seen: NDArray[np.bool_],
    T_lidar_camera: Array,
    pairs: Sequence[tuple[int, int]],
) -> Array:
    """(N, 6, B) displacement of each camera's pairs by a unit of each distortion.

    Images show the relative pose of two cameras whatever the cloud. Their pose to the cloud comes
    from its surfaces, which are distorted as the matches see them. So a pair follows by one motion
    of the cloud, the mean over its cameras, and a camera by the mean over its pairs.

    Args:
        jacobians: (N, 6, B) of the matches of all cameras.
        seen: (N,) which cameras have matches.
        T_lidar_camera: (N, 4, 4).
        pairs: numbers of the cameras of each.
    """
    to_cloud = adjoints(T_lidar_camera)
    of_cloud = to_cloud @ jacobians
    total, count = np.zeros_like(jacobians), np.zeros(len(jacobians))
    for pair in pairs:
        known = [camera for camera in pair if seen[camera]]
        if known:
            total[list(pair)] += of_cloud[known].mean(axis=0)
            count[list(pair)] += 1.0
    mean = total / np.maximum(count, 1.0)[:, None, None]
    return np.asarray(np.linalg.solve(to_cloud, mean))


def _follow(by_pose: Array, by_distortion: Array, weak: Array) -> Array:
    """(6 + k, 3) displacement of pose and lens by a unit of each distortion."""
    return -np.asarray(np.linalg.solve(by_pose.T @ by_pose + weak, by_pose.T @ by_distortion))


def _by_lens(
    block: ProjectionBlock, scale: ResidualScale, T_lidar_camera: gtsam.Pose3, lens: LensVariable
) -> Array:
    """(2 n, k) Jacobian of the whitened residuals by the lens."""
    free = FreeLensBlock(block.rescale(scale=scale.loss_scale, sigma=scale.sigma), lens.free)
    columns = free.columns(to_T_camera_lidar(T_lidar_camera), lens.values)[6:-1]
    return np.asarray(columns.transpose(2, 1, 0).reshape(-1, len(columns)))


def _jacobians(
    block: ProjectionBlock, scale: ResidualScale, T_lidar_camera: gtsam.Pose3
) -> tuple[Array, Array, Array]:
    """(2 n, 6) and (2 n, 3) Jacobians of the whitened residuals, and (2 n,) the residuals."""
    T, columns = to_T_camera_lidar(T_lidar_camera), np.empty((10, 2, len(block)))
    pixels = block.lens.fill_twist_columns(T, block.points_lidar_m, columns[:6])
    moved = distortions_at(block.points_lidar_m) @ T[:3, :3].T
    columns[6:9] = np.einsum("jin,knj->kin", columns[3:6], moved)
    columns[:6] *= -1.0  # T_lidar_camera exp(xi) is exp(-xi) T_camera_lidar
    columns[9] = block.lens.subtract(pixels.T, block.pixels_px).T
    whiten(columns, block.sqrt_information)
    whitened = columns.transpose(2, 1, 0).reshape(-1, 10) / scale.sigma
    return whitened[:, :6], whitened[:, 6:-1], whitened[:, -1]
