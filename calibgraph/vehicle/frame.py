"""The frame of the vehicle: the base LiDAR over the road, and along the direction of travel.

The frame has x ahead, y to the left, z up, and its origin on the road. Clouds give height, roll and
pitch over the road: of each instant the plane of the ground near the vehicle, and over instants the
median, whose error is by their scatter. Poses give the yaw and the pitch of travel, and from turns
how far the LiDAR is ahead of the rear axle, where the origin is. What is typed into the rig is one
more measurement. Of an axis that none of these measures nothing is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.matching.cloud_similarity import find_upright
from calibgraph.model.geometry import move_points, transform
from calibgraph.model.rig import VEHICLE_AXES, Vehicle
from calibgraph.vehicle.travel import Travel

_REACH_M, _GATES_M = 12.0, (0.3, 0.15, 0.08)  # of the ground that counts; of its fits, in turn
_LEAST_INSTANTS, _LEAST_POINTS = 3, 100
_TOLD = np.radians(0.1)  # an axis is known by travel if its sigma is below
_ROUNDS = 5
_LEAST_SIGMA = 1e-5
_TO_DO = {
    "roll": "record at least 3 instants with road in view",
    "pitch": "record at least 3 instants with road in view",
    "yaw": "drive 50 m straight, and put the poses of the base LiDAR beside the data (poses.csv)",
    "x": "drive a figure eight of 100 m slowly, with poses of the base LiDAR beside the data, or "
    "write it into T_vehicle_lidar",
    "y": "write it into T_vehicle_lidar",
    "z": "record at least 3 instants with road in view",
}


class Road(NamedTuple):
    """The road in the axes of the base LiDAR: its (3,) normal, and how far it is below.

    The sigmas are (3,) of the normal's components, and of the height.
    """

    normal: Array
    normal_sigmas: Array
    height_m: float
    height_sigma_m: float


Measured = tuple[Array, Array]
"""(6,) steps of rotation and translation that a source wants, and their information."""


def find_vehicle(
    stated: Vehicle, road: Road | None, travel: Travel
) -> tuple[Vehicle, tuple[str, ...]]:
    """The vehicle with T_vehicle_lidar and its sigmas, and a line on each axis that is unknown.

    Args:
        stated: what is known.
        road: in the axes of the base LiDAR, if it was seen.
        travel: likewise.
    """
    T = _start(stated, road, travel)
    for _ in range(_ROUNDS):
        found = _by_rig(T, stated), _by_road(T, road), _by_travel(T, travel)
        steps, known = np.array(found).transpose(1, 0, 2)
        information = known.sum(axis=0)
        step = (known * steps).sum(axis=0) / np.where(information > 0, information, np.inf)
        T = transform(Rotation.from_rotvec(step[:3]).as_matrix() @ T[:3, :3], T[:3, 3] + step[3:])
    with np.errstate(divide="ignore"):
        sigmas = np.maximum(information**-0.5, _LEAST_SIGMA)
    notes = [
        f"the recording cannot tell {axis} of {stated.frame}: {_TO_DO[axis]}"
        for axis, sigma in zip(VEHICLE_AXES, sigmas, strict=True)
        if np.isinf(sigma)
    ]
    content = {
        "T_vehicle_lidar": T,
        "rotation_sigma_rad": tuple(sigmas[:3].tolist()),
        "translation_sigma_m": tuple(sigmas[3:].tolist()),
    }
    return stated.model_copy(update=content), tuple(notes)


def find_road(clouds_base_m: Sequence[Array]) -> Road | None:
    """The road by the planes of several instants; None if too few see it.

    Args:
        clouds_base_m: per instant (n, 3) of all LiDARs, in the frame of the base.
    """
    T_up_base = find_upright("base", clouds_base_m)
    found = [each for cloud in clouds_base_m if (each := _plane(cloud, T_up_base)) is not None]
    if len(found) < _LEAST_INSTANTS:
        return None
    planes = np.array(found)
    middle, sigmas = np.median(planes, axis=0), planes.std(axis=0, ddof=1) / np.sqrt(len(planes))
    normal = middle[:3] / np.linalg.norm(middle[:3])
    return Road(normal, sigmas[:3], float(middle[3]), float(sigmas[3]))


def _plane(cloud: Array, T_up_base: Array) -> Array | None:
    """(4,) normal and height of the ground near the vehicle, in the axes of the base."""
    points = move_points(cloud, T_up_base)
    points = points[np.hypot(points[:, 0], points[:, 1]) < _REACH_M]
    slope = np.zeros(3)  # z = slope . (x, y, 1)
    for gate_m in _GATES_M:
        rows = np.column_stack([points[:, :2], np.ones(len(points))])
        near = np.abs(points[:, 2] - rows @ slope) < gate_m
        if near.sum() < _LEAST_POINTS:
            return None
        slope = np.linalg.lstsq(rows[near], points[near, 2], rcond=None)[0]
    normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2)
    height_m = normal[2] * (T_up_base[2, 3] - slope[2])
    return np.append(T_up_base[:3, :3].T @ normal, height_m)


def _start(stated: Vehicle, road: Road | None, travel: Travel) -> Array:
    """(4, 4) what is stated, else from the road and the direction of travel."""
    if stated.T_vehicle_lidar is not None:
        return np.array(stated.T_vehicle_lidar)
    z = np.array([0.0, 0.0, 1.0]) if road is None else road.normal
    y = np.cross(z, travel.direction)
    y /= np.linalg.norm(y)
    return transform(np.array([np.cross(y, z), y, z]))


def _by_rig(T: Array, stated: Vehicle) -> Measured:
    if stated.T_vehicle_lidar is None:
        return np.zeros(6), np.zeros(6)
    rotation = Rotation.from_matrix(stated.T_vehicle_lidar[:3, :3] @ T[:3, :3].T).as_rotvec()
    steps = np.concatenate([rotation, stated.T_vehicle_lidar[:3, 3] - T[:3, 3]])
    return steps, stated.sigmas**-2.0


def _by_road(T: Array, road: Road | None) -> Measured:
    """Roll and pitch by which the normal is upright, and the height."""
    steps, information = np.zeros(6), np.zeros(6)
    if road is not None:
        x, y, _ = T[:3, :3] @ road.normal
        sigmas = np.sqrt(T[:3, :3] ** 2 @ road.normal_sigmas**2)
        steps[[0, 1, 5]] = y, -x, road.height_m - T[2, 3]
        found = np.array([sigmas[1], sigmas[0], road.height_sigma_m])
        information[[0, 1, 5]] = np.maximum(found, _LEAST_SIGMA) ** -2.0
    return steps, information


def _by_travel(T: Array, travel: Travel) -> Measured:
    """Pitch and yaw by which the direction of travel is the x axis; x from turns."""
    steps, information = np.zeros(6), np.zeros(6)
    x, y, z = T[:3, :3] @ travel.direction
    steps[1:3] = np.arctan2(z, np.hypot(x, y)), -np.arctan2(y, x)
    sigmas = np.array([travel.pitch_sigma_rad, travel.yaw_sigma_rad])
    information[1:3] = np.where(sigmas < _TOLD, np.maximum(sigmas, _LEAST_SIGMA) ** -2.0, 0.0)
    steps[3], information[3] = travel.ahead_m - T[0, 3], travel.ahead_sigma_m**-2.0
    return steps, information
