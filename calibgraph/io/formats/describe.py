"""A rig in words: where each camera looks and sits, for people to check."""

import math
from collections.abc import Sequence

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import angle_deg, camera_center
from calibgraph.model.rig import RelativePose, Rig

_LIDAR_SIDES = (("ahead", "behind"), ("left", "right"), ("above", "below"))
_CAMERA_SIDES = (("right", "left"), ("below", "above"), ("ahead", "behind"))
_LEAST_M = 0.005
_LEAST_DEG = 0.5
_LEAST_ROLL_DEG = 5.0  # below, a camera hangs straight
_UPRIGHT = 0.95  # of sin(elevation), 72 deg: beyond, left and right mean little


def describe_rig(rig: Rig) -> list[str]:
    """One sentence per camera, in a LiDAR frame x forward, y left, z up, and per relative pose."""
    cameras = (f"{name} {_place(T)}" for name, T in rig.T_camera_lidar.items())
    return [*cameras, *(_pair(pair) for pair in rig.relative_poses)]


def _place(T_camera_lidar: Array) -> str:
    center = _position(camera_center(T_camera_lidar), _LIDAR_SIDES, "the LiDAR")
    return f"looks {_direction(T_camera_lidar)}, {center}"


def _direction(T_camera_lidar: Array) -> str:
    """The axis of the LiDAR frame nearest to the optical axis, and the angles from it."""
    _, down, axis = T_camera_lidar[:3, :3]
    if abs(axis[2]) > _UPRIGHT:
        off = math.degrees(math.acos(min(1.0, abs(float(axis[2])))))
        words = f"along LiDAR {'+' if axis[2] > 0 else '-'}z"
        return words + (f", {off:.0f} deg off it" if off >= _LEAST_DEG else "")
    index = int(np.argmax(np.abs(axis[:2])))
    sign = "+" if axis[index] > 0 else "-"
    heading = math.degrees(math.atan2(axis[1], axis[0]))
    nearest = {"+x": 0.0, "+y": 90.0, "-x": 180.0, "-y": -90.0}[f"{sign}{'xy'[index]}"]
    turned = (heading - nearest + 180.0) % 360.0 - 180.0
    raised = math.degrees(math.asin(axis[2]))
    words = f"along LiDAR {sign}{'xy'[index]}"
    parts = [_turn(turned, "to the left", "to the right"), _turn(raised, "up", "down")]
    parts.append(_roll(axis, down))
    return ", ".join([words, *(part for part in parts if part)])


def _turn(angle: float, positive: str, negative: str) -> str:
    if abs(angle) < _LEAST_DEG:
        return ""
    return f"{abs(angle):.0f} deg {positive if angle > 0 else negative}"


def _roll(axis: Array, down: Array) -> str:
    """How far the image is turned about the optical axis, if it is."""
    level = np.cross(axis, [0.0, 0.0, 1.0])  # to the right, in the horizontal plane
    level /= np.linalg.norm(level)
    straight = np.cross(axis, level)
    roll = math.degrees(math.atan2(float(down @ level), float(down @ straight)))
    return f"its image turned by {abs(roll):.0f} deg" if abs(roll) >= _LEAST_ROLL_DEG else ""


def _position(offset_m: Array, sides: Sequence[tuple[str, str]], what: str) -> str:
    parts = [
        (abs(value), side[0] if value > 0 else side[1])
        for value, side in zip(offset_m.tolist(), sides, strict=True)
        if abs(value) >= _LEAST_M
    ]
    if not parts:
        return f"sits at {what}"
    texts = [f"{value:.2f} m {side}" for value, side in parts]
    joined = " and ".join([", ".join(texts[:-1]), texts[-1]] if len(texts) > 1 else texts)
    preposition = "" if parts[-1][1] in ("above", "below", "behind") else "of "
    return f"sits {joined} {preposition}{what}"


def _pair(pair: RelativePose) -> str:
    place = _position(pair.T_a_b[:3, 3], _CAMERA_SIDES, pair.a)
    turned = angle_deg(pair.T_a_b[:3, :3])
    sigma_deg = math.degrees(pair.rotation_sigma_rad)
    return (
        f"{pair.b} {place}, in the axes of {pair.a}, turned by {turned:.1f} deg against it "
        f"(1 sigma: {sigma_deg:.2g} deg, {100 * pair.translation_sigma_m:.2g} cm)"
    )
