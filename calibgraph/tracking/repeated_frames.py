"""A camera's matches with the points of its last frame: of a frozen LiDAR, nothing new."""

from __future__ import annotations

import numpy as np

from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.repeats import REPEATED_SHARE, point_hashes
from calibgraph.tracking.state import State


def without_repeats(state: State, table: Correspondences) -> Correspondences:
    """The table without cameras most of whose last points are in it again, to the last bit.

    Args:
        state: before the frame.
        table: of the frame.
    """
    repeated = [
        name
        for camera, name in enumerate(state.names)
        if name in table.cameras and _repeats(state, camera, table.of_camera(name))
    ]
    if not repeated:
        return table
    numbers = [table.cameras.index(name) for name in repeated]
    return table.select(~np.isin(table.camera_index, numbers))


def _repeats(state: State, camera: int, table: Correspondences) -> bool:
    """Whether a camera's points are those of the last frame that it has any of."""
    last = _last_hashes(state, camera)
    if last is None or not len(table):
        return False
    again = np.isin(last, point_hashes(table.points_lidar_m))
    return bool(again.mean() > REPEATED_SHARE)


def _last_hashes(state: State, camera: int) -> np.ndarray | None:
    """Of the last frame's matches, absorbed ones or, before the camera has started, waiting."""
    waiting = state.cameras[camera].waiting
    if waiting:
        rows = waiting[-1].of_camera(state.names[camera])
        return point_hashes(rows.points_lidar_m)
    for frame in reversed(state.live_frames):
        if camera in frame.raw:
            block = frame.raw[camera].block
            return point_hashes(block.points_lidar_m)
    return None
