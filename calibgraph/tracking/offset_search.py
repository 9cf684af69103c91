"""A frame that another time offset explains: the first turn after a long way straight ahead.

While the offset is uncertain, so is the pose, along the way of the LiDAR. Frames of another twist
then disagree with the estimate though nothing has moved, and their matches would be gated out.
"""

from __future__ import annotations

from collections.abc import Mapping

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.offsets import Offsets, delayed
from calibgraph.tracking.outlier_frames import agrees, inlier_share
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums

_SIGMAS = np.linspace(-3.0, 3.0, 25)  # of the offset that are tried


def explaining_offsets(
    state: State, sums: Sums, blocks: Mapping[int, CameraBlock]
) -> Offsets | None:
    """The time offsets with which a frame agrees; None if it does at the present ones, or at none.

    Args:
        state: before the frame.
        sums: (n,) of all frames.
        blocks: its matches, per camera.
    """
    if state.offsets is None:
        return None
    found = state.offsets
    for camera, block in blocks.items():
        one, pose = state.cameras[camera], state.T_lidar_camera[camera]
        if not one.started or agrees(block, pose, one):
            continue
        follows = pose_by_offset(sums)[camera]
        tried = _SIGMAS * state.offsets.sigmas_s[camera]
        later = [(delayed(block, step), _moved(pose, follows, step)) for step in tried]
        best = int(np.argmax([inlier_share(*there, one.scale) for there in later]))
        if agrees(*later[best], one):
            value = state.offsets.values_s[camera] + tried[best]
            found = found.with_camera(camera, float(value), float(found.sigmas_s[camera]))
    return None if found is state.offsets else found


def follow(state: State, sums: Sums, offsets: Offsets) -> tuple[gtsam.Pose3, ...]:
    """T_lidar_camera of all cameras that fit their matches best at other time offsets.

    Args:
        state: of the tracker.
        sums: (n,) of all frames.
        offsets: these.
    """
    assert state.offsets is not None
    later_s = (offsets.values_s - state.offsets.values_s).tolist()
    every = zip(state.T_lidar_camera, pose_by_offset(sums), later_s, strict=True)
    return tuple(_moved(pose, follows, seconds) for pose, follows, seconds in every)


def pose_by_offset(sums: Sums) -> Array:
    """(n, 6) step of each pose that makes up for a second of its offset."""
    hessian = sums.hessian[:, :6, :6] + WEAK
    return np.asarray(-np.linalg.solve(hessian, sums.hessian[:, :6, 6:])[..., 0])


def _moved(pose: gtsam.Pose3, follows: Array, seconds: float) -> gtsam.Pose3:
    return pose.retract(follows * seconds)
