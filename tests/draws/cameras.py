"""Level cameras about a LiDAR."""

from typing import Any

import numpy as np

from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera, Intrinsics

# Camera axes (right, down, forward) in LiDAR axes (forward, left, up).
FORWARD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


def camera_at(
    size: tuple[int, int], lens: Intrinsics, xyz_m: tuple[float, ...], yaw_deg: float = 0.0,
    **lens_model: Any,
) -> Camera:  # fmt: skip
    """A level camera at a place in the LiDAR's frame, turned to the left; its size is in px."""
    cosine, sine = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    R = FORWARD @ np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return Camera(
        width_px=size[0], height_px=size[1], intrinsics_px=lens,
        T_camera_lidar=transform(R, -R @ xyz_m), **lens_model,
    )  # fmt: skip
