"""Rigs to simulate with, by name; their extrinsics are the truth."""

from collections.abc import Callable, Mapping

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera, Intrinsics, Rig
from factors import LensModel

Cameras = dict[str, Camera]
Views = Mapping[str, tuple[Array | tuple[float, ...], tuple[float, ...]]]
"""By camera, its position in the LiDAR's frame [m], and yaw, pitch and roll [deg]."""

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


def _kitti() -> Cameras:
    lens = (718.856, 718.856, 607.1928, 185.2157)
    places = {"image_2": (0.27, 0.06, -0.08), "image_3": (0.27, -0.48, -0.08)}
    views = {name: (xyz_m, (-0.1, 0.9, -0.4)) for name, xyz_m in places.items()}
    return _alike(views, (1241, 376), lens)


def _sample() -> Cameras:
    """Small images: two cameras ahead, and a distorted one to the left."""
    left, right = ((0.42, 0.26, -0.34), (6, 4, 0.5)), ((0.41, -0.25, -0.35), (-7, 3.5, -0.7))
    to_the_left = ((0.08, 0.40, -0.30), (75, 5, 0.9))
    wide, size = (-0.14, 0.035, 0.0006, -0.0004, -0.003), (640, 360)
    return {
        **_alike({"front_left": left}, size, (481.3, 480.6, 318.9, 181.2)),
        **_alike({"front_right": right}, size, (478.2, 478.9, 321.4, 178.6)),
        **_alike({"left": to_the_left}, size, (476.5, 477.1, 320.7, 180.9), wide),
    }


def _walkley() -> Cameras:
    """The image size is the paper's; lenses and placement are ours."""
    views: Views = {
        "primary": ((0.35, 0.3, -0.25), (1.2, 2.1, 0.3)),
        "secondary": ((0.35, -0.3, -0.25), (-0.8, 1.6, -0.5)),
    }
    distortion = (-0.11, 0.07, 0.0004, -0.0003)
    return _alike(views, (1920, 1200), (1362.4, 1361.7, 958.3, 604.6), distortion)


def _surround() -> Cameras:
    views: Views = {
        name: (0.45 * _outwards(yaw) + [0.1, 0.0, -0.3], (yaw, 3.0 + 0.4 * i, 0.5 - 0.3 * i))
        for i, (name, yaw) in enumerate(_SURROUND_YAW_DEG.items())
    }
    distortion = (-0.16, 0.05, 0.0003, -0.0002)
    return _alike(views, (1280, 800), (905.2, 904.6, 642.1, 396.8), distortion)


def _fisheye() -> Cameras:
    views: Views = {
        name: (_outwards(yaw) * [1.6, 0.85, 0] + [0, 0, -0.7], (yaw, 20 + i, 0))
        for i, (name, yaw) in enumerate(_FISHEYE_YAW_DEG.items())
    }
    lens, distortion = (385.0, 384.4, 641.5, 478.2), (0.05, -0.015, 0.004, -0.001)
    return _alike(views, (1280, 960), lens, distortion, model="fisheye")


def _omni() -> Cameras:
    views: Views = {
        "front": ((0.35, 0.0, -0.2), (2.0, 8.0, 0.5)),
        "back": ((-0.4, 0.05, -0.25), (179, 9, 0)),
    }
    lens, distortion = (900.0, 898.5, 641.2, 637.4), (1.3, -0.02, 0.04, 0.0003, -0.0002)
    return _alike(views, (1280, 1280), lens, distortion, model="omnidirectional")


def _panorama() -> Cameras:
    width, height = 2048, 1024
    lens = (width / (2 * np.pi), height / np.pi, (width - 1) / 2, (height - 1) / 2)
    views: Views = {"panorama": ((-0.1, 0.05, 0.25), (3.0, 2.0, -1.0))}
    return _alike(views, (width, height), lens, model="equirectangular")


_SURROUND_YAW_DEG = {
    "front": 0.0, "front_left": 60.0, "back_left": 118.0, "back": 180.0, "back_right": -120.0,
    "front_right": -59.0,
}  # fmt: skip
_FISHEYE_YAW_DEG = {"front": 0.0, "left": 91.0, "back": 180.0, "right": -89.0}

_RIGS: dict[str, Callable[[], Cameras]] = {
    "kitti": _kitti, "walkley": _walkley, "surround": _surround, "fisheye": _fisheye,
    "omni": _omni, "panorama": _panorama, "sample": _sample,
}  # fmt: skip
RIG_NAMES = tuple(_RIGS)


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
        )
        for name, (xyz_m, yaw_pitch_roll_deg) in views.items()
    }


def _outwards(yaw_deg: float) -> Array:
    """(3,) the horizontal direction of a heading."""
    return np.asarray(Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()[:, 0])


def _mounted(xyz_m: Array | tuple[float, ...], yaw_pitch_roll_deg: tuple[float, ...]) -> Array:
    """(4, 4) T_camera_lidar of a camera, from its placement in the LiDAR's frame.

    Args:
        xyz_m: (3,) position; x is forward, y left, z up.
        yaw_pitch_roll_deg: rotations about z, then y (down is positive), then x.
    """
    turned = Rotation.from_euler("ZYX", yaw_pitch_roll_deg, degrees=True).as_matrix()
    R = _OPTICAL @ turned.T
    return transform(R, -R @ np.asarray(xyz_m))
