"""When a camera takes its images: the times of a rig, and what they do to points and poses.

A point of a static world, seen by a LiDAR that moves, is elsewhere in its frame when the image is
taken. Points of clouds and tables stay as they are recorded; they are moved where they are used.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.config import LensPart
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera, Rig
from factors import Clock, displace
from factors.columns import CLOCK

_log = logging.getLogger(__name__)

OF_IMAGES = "--interval-s with folders, --motion with bags, or twists_per_s with arrays"
OF_TABLES = "the columns wx_rad_s to vz_m_s of a table, or twist_per_s with every line of JSON"
"""How a user of images, or of tables, gives the motion of the LiDAR."""
_ALONG = 0.9  # mean cosine of turns and ways; of noise it is a half
_ROW_STEPS = 2  # a point 20 rows further is seen 2 ms later, and moves by 2 rows in these at most


def clock_of(camera: Camera) -> Clock:
    """The clock of a camera; what its rig does not state is zero."""
    return Clock(camera.time_offset_s or 0.0, camera.readout_s or 0.0, camera.height_px)


def require_motion(parts: Sequence[LensPart], *, is_known: bool, how: str = OF_TABLES) -> None:
    """Raise a CorrespondenceError if parts of a clock are to be estimated without a motion."""
    clock = [part for part in CLOCK if part in parts]
    if clock and not is_known:
        raise CorrespondenceError(
            f"to estimate {', '.join(clock)}, the motion of the LiDAR must be known: give {how}"
        )


def unused_times(rig: Rig, *, is_known: bool, how: str = OF_TABLES) -> list[str]:
    """A warning, which is logged, if the motion is unknown that the times of a rig need."""
    stated = [n for n, c in rig.cameras.items() if c.time_offset_s or c.readout_s]
    if is_known or not stated:
        return []
    text = (
        f"{', '.join(stated)}: time_offset_s and readout_s are not used, since the motion of the "
        f"LiDAR is unknown; give {how}"
    )
    _log.warning(text)
    return [text]


def odd_motions(table: Correspondences) -> list[str]:
    """A warning, which is logged, if a LiDAR turns about its way: of wheels, swapped columns do."""
    if table.twist_per_s is None or not len(table):
        return []
    turns, moves = np.split(table.twist_per_s, 2, axis=1)
    about_its_way = np.abs((turns * moves).sum(axis=1)).sum()
    whole = (np.linalg.norm(turns, axis=1) * np.linalg.norm(moves, axis=1)).sum()
    if not about_its_way > _ALONG * whole:
        return []
    text = (
        "by its motion, the LiDAR turns about its direction of travel; are these the rotation "
        "wx, wy, wz, then the velocity vx, vy, vz, about and along its own axes?"
    )
    _log.warning(text)
    return [text]


def motion_of(camera: Camera, rows: Correspondences) -> Array | None:
    """(n, 7) the LiDAR's twists, and when the pixels were taken after the points [s].

    None of points of one instant while the motion is unknown. Where the delays of points alone are
    known, the twists are zero, and times of the rig are not used.
    """
    late_s = np.zeros(len(rows)) if rows.late_s is None else rows.late_s
    if rows.twist_per_s is not None:
        times_s = clock_of(camera).times_s(rows.pixels_px[:, 1])
        return np.column_stack([rows.twist_per_s, times_s - late_s])
    return None if rows.late_s is None else np.column_stack([np.zeros((len(rows), 6)), -late_s])


def at_pixels(camera: Camera, rows: Correspondences) -> Correspondences:
    """One camera's rows, with their points where they were when their pixels were taken."""
    motion = motion_of(camera, rows)
    if motion is None or not motion[:, 6].any() or not motion[:, :6].any():
        return rows
    points = displace(rows.points_lidar_m, motion[:, :6], -motion[:, 6])
    return replace(rows, points_lidar_m=points)


def when_taken(camera: Camera, twist_per_s: Array | None) -> Camera:
    """The camera where it is when it takes the middle row, in the frame of the cloud.

    By the (6,) twist of the LiDAR, rotation [rad/s] and translation [m/s]; None: unknown.
    """
    if twist_per_s is None or not camera.time_offset_s:
        return camera
    step = gtsam.Pose3.Expmap(-camera.time_offset_s * twist_per_s)
    return camera.moved_to(camera.T_camera_lidar @ step.matrix())


def seen_at_rows(camera: Camera, points_lidar_m: Array, twist_per_s: Array | None) -> Array:
    """Where points are when a rolling shutter takes the rows that they are seen in.

    Args:
        camera: where it is when it takes the middle row, see :func:`when_taken`.
        points_lidar_m: (w, l, 3), w bundles; all points of one are seen as late as its first.
        twist_per_s: (6,) of the LiDAR; None: unknown.
    """
    if twist_per_s is None or not camera.readout_s:
        return points_lidar_m
    T, seen, clock = camera.T_camera_lidar, points_lidar_m, replace(clock_of(camera), offset_s=0.0)
    for _ in range(_ROW_STEPS):
        pixels, _ = camera.lens.project(seen[:, 0] @ T[:3, :3].T + T[:3, 3])
        times_s = np.repeat(clock.times_s(np.nan_to_num(pixels[:, 1])), seen.shape[1])
        flat = displace(points_lidar_m.reshape(-1, 3), twist_per_s, -times_s)
        seen = flat.reshape(points_lidar_m.shape)
    return seen
