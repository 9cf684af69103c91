"""GTSAM factors for joint multi-camera LiDAR extrinsic calibration.

Every factor acts on ``T_lidar_camera``, the pose of a camera in the LiDAR frame, a ``gtsam.Pose3``.
This package is a leaf: it imports numpy, numba and gtsam, and nothing of calibgraph.
"""

from factors.block import ProjectionBlock, block_factor, to_runs
from factors.block_sums import BlockSums, square_root
from factors.conditioning import (
    smallest_scaled_eigenvalue,
    smallest_scaled_eigenvalues,
    unit_diagonal,
)
from factors.lens import Lens, LensModel
from factors.loss import LOSSES, LossName, robust_noise
from factors.pose import (
    camera_prior_factor,
    pose_sigmas,
    relative_pose_factor,
    relative_prior_factor,
)
from factors.projection import projection_factor, projection_residual

__all__ = [
    "LOSSES",
    "BlockSums",
    "Lens",
    "LensModel",
    "LossName",
    "ProjectionBlock",
    "block_factor",
    "camera_prior_factor",
    "pose_sigmas",
    "projection_factor",
    "projection_residual",
    "relative_pose_factor",
    "relative_prior_factor",
    "robust_noise",
    "smallest_scaled_eigenvalue",
    "smallest_scaled_eigenvalues",
    "square_root",
    "to_runs",
    "unit_diagonal",
]
