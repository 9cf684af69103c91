"""GTSAM factors for joint multi-camera LiDAR extrinsic calibration.

Every factor acts on ``T_lidar_camera``, the pose of a camera in the LiDAR frame, a ``gtsam.Pose3``.
This package is a leaf: it imports numpy, numba and gtsam, and nothing of calibgraph.
"""

from factors.arrays import BlockSums, to_runs
from factors.block import (
    ProjectionBlock,
    block_factor,
    fields_px,
    projection_factor,
    projection_residual,
)
from factors.columns import Clock, Columns, displace
from factors.conditioning import (
    smallest_scaled_eigenvalues,
    unit_diagonal,
)
from factors.lens import Lens, LensModel, ray_spreads, unproject
from factors.pairs import (
    PairBlock,
    pair_block_factor,
    placed_factor,
)
from factors.pose import (
    camera_prior_factor,
    cauchy_noise,
    displaced_between_factor,
    linear_factor,
    lossless_factor,
    pose_sigmas,
    relative_pose_factor,
    relative_prior_factor,
)

__all__ = [
    "BlockSums",
    "Clock",
    "Columns",
    "Lens",
    "LensModel",
    "PairBlock",
    "ProjectionBlock",
    "block_factor",
    "camera_prior_factor",
    "cauchy_noise",
    "displaced_between_factor",
    "displace",
    "fields_px",
    "linear_factor",
    "lossless_factor",
    "pair_block_factor",
    "placed_factor",
    "pose_sigmas",
    "projection_factor",
    "projection_residual",
    "ray_spreads",
    "relative_pose_factor",
    "relative_prior_factor",
    "smallest_scaled_eigenvalues",
    "to_runs",
    "unit_diagonal",
    "unproject",
]
