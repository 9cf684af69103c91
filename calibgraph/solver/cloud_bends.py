"""How the sensor bends the cloud, and what that does to the matches of each camera.

A rigid motion of the cloud moves all cameras alike. Three errors of recorded sensors do not: beams
that all point higher or lower than is stated, which pitch the cloud along every line of sight;
beams that are spread too far or too little; and motion during a turn, which displaces each heading
by another amount. Each is one unknown number of the whole rig; a camera's matches follow it by a
displacement that their own points show.
"""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale
from factors import ProjectionBlock

Array = NDArray[np.float64]

_SAMPLE = 1000  # correspondences: the displacement is a ratio of two sums over them
_STEP = 1e-4  # of the difference quotient: far below a pixel, far above rounding
_NO_LOSS = 1e6  # sigmas at which it bends: inliers are far below, and weigh nearly the same


def bends_at(points_lidar_m: Array) -> Array:
    """(3, n, 3) displacements in the LiDAR frame, by a unit of each bend.

    Elevations that are all a radian higher; elevations twice as far from the horizon; a metre of
    motion. This is ahead, over a turn that begins and ends behind: a point straight ahead is where
    it is reported, one behind is half of it off.

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


def bend_shifts(
    block: CameraBlock, scale: ResidualScale, T_lidar_camera: gtsam.Pose3, weak: Array
) -> Array:
    """(6, 3) by how much the pose of a camera's matches follows a unit of each bend.

    With b the gradient of the squared residuals and H their Hessian, -H^-1 (db / dbend), in the
    tangent of ``T_lidar_camera``.

    Args:
        block: inliers of one camera.
        scale: of their residuals.
        T_lidar_camera: their minimum.
        weak: (6, 6) information that is added to H, so that few matches have an inverse.
    """
    some = block.select_evenly(_SAMPLE).block.rescale(scale=_NO_LOSS, sigma=scale.sigma)
    here = some.sums(T_lidar_camera)
    share = len(some) / len(block)
    moved = [
        _displace(some, _STEP * bend).sums(T_lidar_camera).gradient
        for bend in bends_at(some.points_lidar_m)
    ]
    slopes = (np.column_stack(moved) - here.gradient[:, None]) / _STEP
    return -np.asarray(np.linalg.solve(here.hessian + share * weak, slopes))


def _displace(block: ProjectionBlock, step: Array) -> ProjectionBlock:
    """The same correspondences, their points moved by (n, 3) [m]."""
    return ProjectionBlock(
        block.lens, block.points_lidar_m + step, block.pixels_px,
        block.sqrt_information, block.loss, block.scale, block.sigma,
    )  # fmt: skip
