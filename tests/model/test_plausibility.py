"""Values that cannot be right are named with their numbers; usual rigs are left alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Camera, Intrinsics, Rig, load_rig
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.model.plausibility import find_implausible
from calibgraph.model.rig import RelativePose
from factors import LensModel
from tests.conftest import SAMPLE

HD = {"size": (1280, 720), "centre": (640, 360)}


def lines(  # noqa: PLR0913 - a camera
    *,
    focal: tuple[float, float] = (480, 480),
    centre: tuple[float, float] = (320, 180),
    size: tuple[int, int] = (640, 360),
    distortion: tuple[float, ...] = (),
    model: LensModel = "pinhole",
    shift_m: float = 0.1,
    T: np.ndarray = T_OPTICAL_LINK,
) -> list[str]:
    """The lines about a rig of one camera."""
    T = T.copy()
    T[2, 3] += shift_m
    camera = Camera(
        model=model,
        width_px=size[0],
        height_px=size[1],
        intrinsics_px=Intrinsics(fx=focal[0], fy=focal[1], cx=centre[0], cy=centre[1]),
        distortion=distortion,
        T_camera_lidar=T,
    )
    return find_implausible(Rig(cameras={"a": camera}))


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ({"shift_m": 300.0}, "a: the camera is 300 m from the LiDAR: lengths in millimetres or"),
        ({"T": np.eye(4), "shift_m": 0.0}, "a: T_camera_lidar is the identity"),
        ({"focal": (480, 1)}, "a: focal lengths 480 and 1 px"),
        ({"focal": (3.6, 3.6)}, "a: focal length 3.6 px of a 640x360 px image: millimetres?"),
        ({"focal": (2e4, 2e4)}, "a: focal length 2e+04 px of a 640x360 px image: of another"),
        ({"centre": (80, 45)}, "a: principal point (80, 45) of a 640x360 px image: a camera_info"),
        ({"centre": (220, 100)}, "a: principal point (220, 100) of a 640x360 px image"),
        ({"focal": (960, 960), "centre": (640, 360)}, "a: principal point (640, 360) of a 640x360"),
        ({"size": (360, 640)}, "a: principal point (320, 180) of a 360x640 px image"),
        ({"distortion": (-0.5, 0, 0, 0)}, "reaches 39.2 deg from its axis and covers 75% of the"),
        ({"distortion": (1450, -5800, 4e-4, -7e-4, 5200)}, "4.47 deg from its axis, 36.9 deg if"),
        ({"distortion": (0.01, -0.02, 0.08, -0.03)}, "shifts the image's border by 19%, by p1"),
        (
            {"model": "fisheye", "focal": (300, 300), "distortion": (1e3, 0, 0, 0)},
            "a: the lens reaches 5.91 deg from its axis, 68.9 deg if undistorted: distortion",
        ),
    ],
)
def test_a_value_that_cannot_be_right_is_named_once_with_its_numbers(
    wrong: dict[str, Any], expected: str
) -> None:
    (line,) = lines(**wrong)
    assert expected in line


@pytest.mark.parametrize(
    "usual",
    [
        {"focal": (6000, 6000), "distortion": (-0.5, 100.0, 0, 0, 0)},  # telephoto
        {"centre": (320, 60)},  # sky cut off
        {"centre": (450, 185)},  # rectified pair
        {"size": (320, 360), "centre": (160, 180), "focal": (240, 480)},  # every other column
        {**HD, "focal": (150, 150), "model": "fisheye", "distortion": (-0.02, -0.005, 0.003, 0)},
        {**HD, "focal": (400, 400), "model": "fisheye", "distortion": (-0.03, 0.01, -6e-3, 8e-4)},
        {**HD, "focal": (640, 640), "distortion": (0.4, -2.6, 5e-4, -3e-4, 1.5, 0.28, -2.4, 1.4)},
        {**HD, "focal": (204, 204), "model": "equirectangular", "centre": (0, 360)},
        {
            "size": (1400, 1400),
            "focal": (1336, 1336),
            "centre": (717, 706),
            "model": "omnidirectional",
            "distortion": (2.2, 0.017, 1.65, 4e-4, 4e-4),
        },
    ],
)
def test_usual_lenses_are_left_alone(usual: dict[str, Any]) -> None:
    assert lines(**usual) == []


def test_cameras_that_are_too_far_apart_are_named() -> None:
    rig = load_rig(SAMPLE)
    T = np.eye(4)
    T[0, 3] = 54.0
    pair = RelativePose(
        a="left", b="front_left", T_a_b=T, rotation_sigma_rad=0.1, translation_sigma_m=0.1
    )
    assert find_implausible(rig) == []
    (line,) = find_implausible(rig.model_copy(update={"relative_poses": (pair,)}))
    assert line.startswith("front_left is 54 m from left: lengths in millimetres or centimetres?")


def test_no_camera_of_real_rigs_is_named(realdata: Path) -> None:
    rigs = [*realdata.glob("*/rig.yaml"), *realdata.glob("kitti_odometry/sequences/*")]
    assert len(rigs) > 10
    assert {path: found for path in rigs if (found := find_implausible(load_rig(path)))} == {}
