"""Rigs to simulate with, by name; their extrinsics are the truth."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera, Intrinsics, Rig

Array = NDArray[np.float64]

_OPTICAL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Rotation of a camera that looks along the LiDAR's x axis; the LiDAR's z axis is up."""


def rig_of(name: str) -> Rig:
    """A rig by name.

    Args:
        name: ``kitti``: a stereo pair 54 cm apart, 1241 x 376, as in KITTI's odometry sequences;
            ``walkley``: a pair 60 cm apart, 1920 x 1200, wider and distorted; ``surround``: six
            cameras all round, 1280 x 800, distorted, with little overlap; ``fisheye``: four
            fisheyes of 190 degrees, 1280 x 960, one to each side of a vehicle; ``omni``: two lenses
            of the unified model, 200 degrees, 1280 x 1280, ahead and back; ``panorama``: one
            equirectangular camera that sees all round, 2048 x 1024, above the LiDAR; ``sample``:
            two cameras ahead and one to the left, 640 x 360, as in ``data/sample``.

    Raises:
        ValueError: if there is no such rig.
    """
    if name not in _RIGS:
        raise ValueError(f"unknown rig {name!r}; known are {', '.join(_RIGS)}")
    return Rig(cameras=_RIGS[name]())


def _kitti() -> dict[str, Camera]:
    places = {"image_2": 0.06, "image_3": -0.48}
    return {
        name: Camera(
            width_px=1241,
            height_px=376,
            intrinsics_px=Intrinsics(fx=718.856, fy=718.856, cx=607.1928, cy=185.2157),
            T_camera_lidar=_mounted((0.27, y, -0.08), (-0.1, 0.9, -0.4)),
        )
        for name, y in places.items()
    }


def _sample() -> dict[str, Camera]:
    """Small images: two cameras ahead, and a distorted one to the left."""
    wide = (-0.14, 0.035, 0.0006, -0.0004, -0.003)
    views = {
        "front_left": ((481.3, 480.6, 318.9, 181.2), (), (0.42, 0.26, -0.34), (6, 4, 0.5)),
        "front_right": ((478.2, 478.9, 321.4, 178.6), (), (0.41, -0.25, -0.35), (-7, 3.5, -0.7)),
        "left": ((476.5, 477.1, 320.7, 180.9), wide, (0.08, 0.40, -0.30), (75, 5, 0.9)),
    }
    return {
        name: Camera(
            width_px=640,
            height_px=360,
            intrinsics_px=Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy),
            distortion=distortion,
            T_camera_lidar=_mounted(xyz_m, turns_deg),
        )
        for name, ((fx, fy, cx, cy), distortion, xyz_m, turns_deg) in views.items()
    }


def _walkley() -> dict[str, Camera]:
    """The image size is the paper's; lenses and placement are ours."""
    lens = (-0.11, 0.07, 0.0004, -0.0003)
    views = {"primary": (0.3, (1.2, 2.1, 0.3)), "secondary": (-0.3, (-0.8, 1.6, -0.5))}
    return {
        name: Camera(
            width_px=1920,
            height_px=1200,
            intrinsics_px=Intrinsics(fx=1362.4, fy=1361.7, cx=958.3, cy=604.6),
            distortion=lens,
            T_camera_lidar=_mounted((0.35, y, -0.25), turns),
        )
        for name, (y, turns) in views.items()
    }


def _surround() -> dict[str, Camera]:
    cameras = {}
    for index, (name, yaw) in enumerate(_SURROUND_YAW_DEG.items()):
        outwards = Rotation.from_euler("z", yaw, degrees=True).as_matrix()[:, 0]
        tilt, roll = 3.0 + 0.4 * index, 0.5 - 0.3 * index
        cameras[name] = Camera(
            width_px=1280,
            height_px=800,
            intrinsics_px=Intrinsics(fx=905.2, fy=904.6, cx=642.1, cy=396.8),
            distortion=(-0.16, 0.05, 0.0003, -0.0002),
            T_camera_lidar=_mounted(0.45 * outwards + [0.1, 0.0, -0.3], (yaw, tilt, roll)),
        )
    return cameras


def _fisheye() -> dict[str, Camera]:
    cameras = {}
    for index, (name, yaw) in enumerate(_FISHEYE_YAW_DEG.items()):
        outwards = Rotation.from_euler("z", yaw, degrees=True).as_matrix()[:, 0]
        cameras[name] = Camera(
            model="fisheye",
            width_px=1280,
            height_px=960,
            intrinsics_px=Intrinsics(fx=385.0, fy=384.4, cx=641.5, cy=478.2),
            distortion=(0.05, -0.015, 0.004, -0.001),
            T_camera_lidar=_mounted(outwards * [1.6, 0.85, 0] + [0, 0, -0.7], (yaw, 20 + index, 0)),
        )
    return cameras


def _omni() -> dict[str, Camera]:
    places = {
        "front": ((0.35, 0.0, -0.2), (2.0, 8.0, 0.5)),
        "back": ((-0.4, 0.05, -0.25), (179, 9, 0)),
    }
    return {
        name: Camera(
            model="omnidirectional",
            width_px=1280,
            height_px=1280,
            intrinsics_px=Intrinsics(fx=900.0, fy=898.5, cx=641.2, cy=637.4),
            distortion=(1.3, -0.02, 0.04, 0.0003, -0.0002),
            T_camera_lidar=_mounted(xyz_m, turns_deg),
        )
        for name, (xyz_m, turns_deg) in places.items()
    }


def _panorama() -> dict[str, Camera]:
    width, height = 2048, 1024
    return {
        "panorama": Camera(
            model="equirectangular",
            width_px=width,
            height_px=height,
            intrinsics_px=Intrinsics(
                fx=width / (2 * np.pi), fy=height / np.pi, cx=(width - 1) / 2, cy=(height - 1) / 2
            ),
            T_camera_lidar=_mounted((-0.1, 0.05, 0.25), (3.0, 2.0, -1.0)),
        )
    }


_SURROUND_YAW_DEG = {
    "front": 0.0, "front_left": 60.0, "back_left": 118.0, "back": 180.0, "back_right": -120.0,
    "front_right": -59.0,
}  # fmt: skip
_FISHEYE_YAW_DEG = {"front": 0.0, "left": 91.0, "back": 180.0, "right": -89.0}

_RIGS: dict[str, Callable[[], dict[str, Camera]]] = {
    "kitti": _kitti, "walkley": _walkley, "surround": _surround, "fisheye": _fisheye,
    "omni": _omni, "panorama": _panorama, "sample": _sample,
}  # fmt: skip
RIG_NAMES = tuple(_RIGS)


def _mounted(xyz_m: Array | tuple[float, ...], yaw_pitch_roll_deg: tuple[float, ...]) -> Array:
    """(4, 4) T_camera_lidar of a camera, from its placement in the LiDAR's frame.

    Args:
        xyz_m: (3,) position; x is forward, y left, z up.
        yaw_pitch_roll_deg: rotations about z, then y (down is positive), then x.
    """
    turned = Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True).as_matrix()
    R = _OPTICAL @ turned.T
    return transform(R, -R @ np.asarray(xyz_m))
