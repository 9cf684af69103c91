"""When a camera takes its images: the times of a rig, and what they do to points and poses.

A point of a static world, seen by a LiDAR that moves, is elsewhere in its frame when the image is
taken. Points of clouds and tables stay as they are recorded; they are moved where they are used.
"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera
from factors import Clock, displace


def clock_of(camera: Camera) -> Clock:
    """The clock of a camera; what its rig does not state is zero."""
    return Clock(camera.time_offset_s or 0.0, camera.readout_s or 0.0, camera.height_px)


def motion_of(camera: Camera, rows: Correspondences) -> Array | None:
    """(n, 7) the LiDAR's twists, and when the pixels were taken [s]; None if it is unknown."""
    if rows.twist_per_s is None:
        return None
    times_s = clock_of(camera).times_s(rows.pixels_px[:, 1])
    return np.column_stack([rows.twist_per_s, times_s])


def at_pixels(camera: Camera, rows: Correspondences) -> Correspondences:
    """One camera's rows, with their points where they were when their pixels were taken."""
    motion = motion_of(camera, rows)
    if motion is None or not motion[:, 6].any():
        return rows
    points = displace(rows.points_lidar_m, motion[:, :6], -motion[:, 6])
    return replace(rows, points_lidar_m=points)


def when_taken(camera: Camera, twist_per_s: Array | None) -> Camera:
    """The camera where it is when it takes the middle row, in the frame of the cloud.

    Args:
        camera: on the LiDAR.
        twist_per_s: (6,) of the LiDAR, rotation [rad/s] and translation [m/s]; None: unknown.
    """
    if twist_per_s is None or not camera.time_offset_s:
        return camera
    step = gtsam.Pose3.Expmap(-camera.time_offset_s * twist_per_s)
    return camera.moved_to(camera.T_camera_lidar @ step.matrix())
