"""Quaternions and roll, pitch, yaw, as files of others have them."""

import math
from collections.abc import Sequence

import gtsam
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import ROUNDING

_TURN_RAD = 2 * math.pi + ROUNDING


def quaternion_xyzw(T: Array) -> list[float]:
    """[x, y, z, w] of the rotation of a (4, 4), w not negative."""
    found = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return [float(value) for value in found]


def roll_pitch_yaw(T: Array) -> list[float]:
    """[roll, pitch, yaw] [rad] about fixed x, y, z: R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF."""
    return [float(value) for value in gtsam.Rot3(T[:3, :3]).rpy()]


def pose_of_quaternion(xyz_m: Sequence[float], xyzw: Sequence[float]) -> Array:
    """(4, 4) of a translation and a quaternion of length 1, up to rounded digits."""
    length = math.hypot(*xyzw)
    if not abs(length - 1.0) <= ROUNDING:
        raise ValueError(f"quaternion {list(xyzw)} has length {length:.3g}, expected 1")
    return transform(Rotation.from_quat(xyzw).as_matrix(), xyz_m)


def pose_of_angles(xyz_m: Sequence[float], rpy_rad: Sequence[float]) -> Array:
    """(4, 4) of a translation and roll, pitch, yaw about fixed axes.

    Raises:
        ValueError: if an angle is beyond a turn: of degrees, most are.
    """
    roll, pitch, yaw = rpy_rad
    if max(map(abs, rpy_rad)) > _TURN_RAD:
        raise ValueError(
            f"roll, pitch, yaw are {roll:g}, {pitch:g}, {yaw:g} rad, beyond 2 pi: are they in "
            "degrees? give radians, 90 deg is 1.5708"
        )
    return transform(gtsam.Rot3.RzRyRx(roll, pitch, yaw).matrix(), xyz_m)
