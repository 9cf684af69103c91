"""Rigs to simulate with, by name; their extrinsics are the truth."""

from collections.abc import Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import T_OPTICAL_LINK, invert, transform
from calibgraph.model.rig import Camera, Intrinsics, Rig
from factors import LensModel

Cameras = dict[str, Camera]
Views = Mapping[str, tuple[Array | tuple[float, ...], tuple[float, ...]]]
"""By camera, its position in the LiDAR's frame [m], and yaw, pitch and roll [deg]."""


def rig_of(name: str) -> Rig:
    """A rig by name.

    Args:
        name: ``kitti``: a stereo pair 54 cm apart, 1241 x 376, as in KITTI's odometry sequences;
            ``walkley``: a pair 60 cm apart, 1920 x 1200, wider and distorted; ``surround``: six
            cameras all round, 1280 x 800, distorted, with little overlap; ``fisheye``: four
            fisheyes of 190 degrees, 1280 x 960, one to each side of a vehicle; ``omni``: two lenses
            of the unified model, 200 degrees, 1280 x 1280, ahead and back; ``sample``: two
            cameras ahead and one to the left, 640 x 360, as in ``data/sample``.

    Raises:
        ValueError: if there is no such rig.
    """
    if name not in _RIGS:
        raise ValueError(f"unknown rig {name!r}; known are {', '.join(_RIGS)}")
    return Rig(cameras={camera: each for group in _RIGS[name] for camera, each in group.items()})


def _alike(
    views: Views,
    size_px: tuple[int, int],
    fx_fy_cx_cy: tuple[float, ...],
    distortion: tuple[float, ...] = (),
    *,
    model: LensModel = "pinhole",
) -> Cameras:
    """Cameras with the same lens, each at its place."""
    fx, fy, cx, cy = fx_fy_cx_cy
    return {
        name: Camera(
            model=model,
            width_px=size_px[0],
            height_px=size_px[1],
            intrinsics_px=Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy),
            distortion=distortion,
            T_camera_lidar=_mounted(xyz_m, yaw_pitch_roll_deg),
        )  # fmt: skip
        for name, (xyz_m, yaw_pitch_roll_deg) in views.items()
    }


def _outwards(yaw_deg: float) -> Array:
    """(3,) the horizontal direction of a heading."""
    return np.asarray(Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()[:, 0])


def _mounted(xyz_m: Array | tuple[float, ...], yaw_pitch_roll_deg: tuple[float, ...]) -> Array:
    """(4, 4) T_camera_lidar of a camera at (3,) x forward, y left, z up in the LiDAR's frame.

    It is turned about z, then y (down is positive), then x.
    """
    turn = Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True)
    return np.asarray(T_OPTICAL_LINK @ invert(transform(turn, xyz_m)))


_PAIR_TURN_DEG = (-0.1, 0.9, -0.4)
_SURROUND_YAW_DEG = {
    "front": 0.0, "front_left": 60.0, "back_left": 118.0, "back": 180.0, "back_right": -120.0,
    "front_right": -59.0,
}  # fmt: skip
_FISHEYE_YAW_DEG = {"front": 0.0, "left": 91.0, "back": 180.0, "right": -89.0}

_RIGS: dict[str, list[Cameras]] = {
    "kitti": [
        _alike(
            {"image_2": ((0.27, 0.06, -0.08), _PAIR_TURN_DEG),
             "image_3": ((0.27, -0.48, -0.08), _PAIR_TURN_DEG)},
            (1241, 376), (718.856, 718.856, 607.1928, 185.2157),
        ),
    ],
    "walkley": [  # the image size is the paper's; lenses and placement are ours
        _alike(
            {"primary": ((0.35, 0.3, -0.25), (1.2, 2.1, 0.3)),
             "secondary": ((0.35, -0.3, -0.25), (-0.8, 1.6, -0.5))},
            (1920, 1200), (1362.4, 1361.7, 958.3, 604.6), (-0.11, 0.07, 0.0004, -0.0003),
        ),
    ],
    "surround": [
        _alike(
            {name: (0.45 * _outwards(yaw) + [0.1, 0.0, -0.3], (yaw, 3.0 + 0.4 * i, 0.5 - 0.3 * i))
             for i, (name, yaw) in enumerate(_SURROUND_YAW_DEG.items())},
            (1280, 800), (905.2, 904.6, 642.1, 396.8), (-0.16, 0.05, 0.0003, -0.0002),
        ),
    ],
    "fisheye": [
        _alike(
            {name: (_outwards(yaw) * [1.6, 0.85, 0] + [0, 0, -0.7], (yaw, 20 + i, 0))
             for i, (name, yaw) in enumerate(_FISHEYE_YAW_DEG.items())},
            (1280, 960), (385.0, 384.4, 641.5, 478.2), (0.05, -0.015, 0.004, -0.001),
            model="fisheye",
        ),
    ],
    "omni": [
        _alike(
            {"front": ((0.35, 0.0, -0.2), (2.0, 8.0, 0.5)),
             "back": ((-0.4, 0.05, -0.25), (179, 9, 0))},
            (1280, 1280), (900.0, 898.5, 641.2, 637.4), (1.3, -0.02, 0.04, 0.0003, -0.0002),
            model="omnidirectional",
        ),
    ],
    "sample": [  # small images: two cameras ahead, and a distorted one to the left
        _alike({"front_left": ((0.42, 0.26, -0.34), (6, 4, 0.5))},
               (640, 360), (481.3, 480.6, 318.9, 181.2)),
        _alike({"front_right": ((0.41, -0.25, -0.35), (-7, 3.5, -0.7))},
               (640, 360), (478.2, 478.9, 321.4, 178.6)),
        _alike({"left": ((0.08, 0.40, -0.30), (75, 5, 0.9))},
               (640, 360), (476.5, 477.1, 320.7, 180.9),
               (-0.14, 0.035, 0.0006, -0.0004, -0.003)),
    ],
}  # fmt: skip
RIG_NAMES = tuple(_RIGS)
