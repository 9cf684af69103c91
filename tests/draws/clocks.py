"""Motion of a LiDAR, and correspondences of images that are taken at another time."""

from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from factors import Clock, displace

_TURN_RAD_S = (0.02, 0.02, 0.2)
_SPEED_M_S, _SLIP_M_S = (2.0, 15.0), (0.1, 0.05)


def draw_twists(frames: int, rng: np.random.Generator) -> Array:
    """(frames, 6) of a LiDAR with x ahead on a car in town: rotation [rad/s], translation [m/s]."""
    turns = rng.normal(0.0, _TURN_RAD_S, (frames, 3))
    ahead, slip = rng.uniform(*_SPEED_M_S, (frames, 1)), rng.normal(0.0, _SLIP_M_S, (frames, 2))
    return np.hstack([turns, ahead, slip])


def put_clock_error(
    table: Correspondences, rig: Rig, twists_per_s: Array, clock: Clock
) -> Correspondences:
    """The table of a LiDAR that moved, if its points were those at the times of the pixels.

    Args:
        table: of one instant.
        rig: the heights of its images.
        twists_per_s: (f, 6) by the number of the frame.
        clock: of all cameras; its height is not used.
    """
    heights = np.array([rig.cameras[name].height_px for name in table.cameras])
    shares = (table.pixels_px[:, 1] + 0.5) / heights[table.camera_index] - 0.5
    twists = twists_per_s[table.frame]
    points = displace(table.points_lidar_m, twists, clock.offset_s + clock.readout_s * shares)
    return replace(table, points_lidar_m=points, twist_per_s=twists)
