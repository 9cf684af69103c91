"""Rigs in files: what cannot be right is refused or named; usual rigs are left alone."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import Camera, FileError, Intrinsics, Rig, load_rig
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.model.plausibility import find_implausible
from calibgraph.model.rig import RelativePose, rigid_transform
from factors import LensModel
from tests.conftest import SAMPLE, stereo_relative_pose


def written(rig: Rig, folder: Path, **changes: Any) -> Path:
    """A rig file with some keys of its camera `left` changed, or left out if they are None."""
    content = rig.model_dump(mode="json")
    left = content["cameras"]["left"] | changes
    content["cameras"]["left"] = {key: value for key, value in left.items() if value is not None}
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_rig_file_returns_the_same_rig(pair: Rig, tmp_path: Path) -> None:
    rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    rig.save(tmp_path / "rig.yaml")
    loaded = load_rig(tmp_path / "rig.yaml")
    assert loaded.model_dump_json() == rig.model_dump_json()


BAD = {
    "unknown key": ({"fov": 90}, r"unknown key 'cameras.left.fov'"),
    "inverse": (
        {"T_camera_lidar": None, "T_lidar_camera": np.eye(4).tolist()},
        r"unknown key 'cameras.left.T_lidar_camera'; give its inverse, T_camera_lidar",
    ),
    "focal length": (
        {"intrinsics_px": {"fx": -1, "fy": 700, "cx": 1, "cy": 1}},
        r"intrinsics_px.fx.*-1",
    ),
    "missing key": ({"intrinsics_px": {"fx": 700, "fy": 700, "cx": 1}}, r"cy' is missing"),
    "not finite": ({"T_camera_lidar": [[math.nan] * 4] * 4}, r"not finite"),
    "far away": (
        {"T_camera_lidar": [[1, 0, 0, 1e308], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        r"holds 1e\+308; lengths are in metres",
    ),
    "long lens": (
        {"intrinsics_px": {"fx": 1e300, "fy": 700, "cx": 1, "cy": 1}},
        r"intrinsics_px.fx.*less than or equal to 1000000",
    ),
    "large coefficient": ({"distortion": [1e300] * 5}, r"distortion.0.*1e\+300"),
    "shape": ({"T_camera_lidar": [[1, 0], [0, 1]]}, r"4x4.*\(2, 2\)"),
    "not a rotation": ({"T_camera_lidar": (2 * np.eye(4)).tolist()}, r"last row"),
    "scaled": ({"T_camera_lidar": np.diag([2.0, 2, 2, 1]).tolist()}, r"not a rotation"),
    "mirrored": ({"T_camera_lidar": np.diag([-1.0, 1, 1, 1]).tolist()}, r"determinant -1"),
    "distortion": (
        {"distortion": [0.1, 0.2]},
        r"2 distortion coefficients found, expected 0, 4, 5, 8: .*\[k1, k2, p1, p2, k3\]",
    ),
    "lens of ROS": ({"model": "plumb_bob"}, r"called 'pinhole' here; .*k1, k2, p1, p2"),
    "lens of Kalibr": (
        {"model": "equidistant"},
        r"called 'fisheye' here; its distortion is \[k1, k2, k3, k4\]",
    ),
    "unknown lens": ({"model": "ds"}, r"'fisheye' or 'omnidirectional', found 'ds'"),
    "mirror": (
        {"model": "omnidirectional", "distortion": [-1, 0, 0, 0, 0]},
        r"xi of the unified model is -1, expected 0 to 100",
    ),
    "Kalibr's omni": ({"model": "omni"}, r"called 'omnidirectional' here"),
    "fisheye without": ({"model": "fisheye", "distortion": []}, r"0 distortion"),
    "size": ({"width_px": 0}, r"width_px"),
    "gigapixels": ({"width_px": 28_000, "height_px": 28_000}, r"28000x28000 px are over 2e\+08"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_rig_file_is_refused_in_one_line(case: str, pair: Rig, tmp_path: Path) -> None:
    changes, message = BAD[case]
    path = written(pair, tmp_path, **changes)
    with pytest.raises(FileError, match=message) as caught:
        load_rig(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_merge_keys_may_share_a_lens(pair: Rig, tmp_path: Path) -> None:
    T = pair.T_camera_lidar["left"].tolist()
    path = tmp_path / "rig.yaml"
    path.write_text(
        "format: calibgraph-rig/1\ncameras:\n"
        "  a: &a {width_px: 640, height_px: 480, intrinsics_px: {fx: 500, fy: 500, cx: 320, cy: 9}"
        f", T_camera_lidar: {T}}}\n"
        "  b: {<<: *a, width_px: 320}\n"
    )
    cameras = load_rig(path).cameras
    assert (cameras["a"].width_px, cameras["b"].width_px) == (640, 320)


UNSEEN = ("\x7f", "\x1b[2J", "\x85", "\x9b2J", "\u202e", "\u2066", "\u200b", "\ud800")


@pytest.mark.parametrize(
    "name",
    [
        "",
        ".",
        "..",
        "../../up",
        "a/b",
        "a\\b",
        "a\nb",
        "x" * 101,
        *(f"a{mark}b" for mark in UNSEEN),
    ],
)
def test_camera_names_that_are_no_file_names_are_refused(name: str, pair: Rig) -> None:
    with pytest.raises(ValueError, match="camera name"):
        Rig(cameras={name: pair.cameras["left"]})


def test_a_relative_pose_must_name_two_cameras(pair: Rig) -> None:
    relative = stereo_relative_pose(pair)
    for change, message in [({"b": "rear"}, "names camera 'rear'"), ({"b": "left"}, "itself")]:
        with pytest.raises(ValueError, match=message):
            Rig(cameras=pair.cameras, relative_poses=(relative.model_copy(update=change),))


def test_rounded_digits_are_made_a_rotation_again() -> None:
    T = np.eye(4)
    T[:3, :3] = np.round([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]], 4)
    T[0, 0] += 4e-5
    R = rigid_transform(T)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)


HD = {"size": (1280, 720), "centre": (640, 360)}


def implausible(  # noqa: PLR0913 - a camera
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
        ({"distortion": (-0.5, 0, 0, 0)}, "reaches 22.3 deg from its axis, and not the whole"),
        (
            {"distortion": (1450, -5800, 4e-4, -7e-4, 5200)},
            "a: the lens reaches 4.49 deg from its axis",
        ),
        (
            {"model": "fisheye", "focal": (300, 300), "distortion": (1e3, 0, 0, 0)},
            "a: the lens reaches 5.95 deg from its axis, 70.1 deg if undistorted: distortion",
        ),
    ],
)
def test_a_value_that_cannot_be_right_is_named_once_with_its_numbers(
    wrong: dict[str, Any], expected: str
) -> None:
    (line,) = implausible(**wrong)
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
    assert implausible(**usual) == []


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


@pytest.mark.realdata
def test_no_camera_of_real_rigs_is_named(realdata: Path) -> None:
    rigs = [*realdata.glob("*/rig.yaml"), *realdata.glob("kitti_odometry/sequences/*")]
    assert len(rigs) > 10
    assert {path: found for path in rigs if (found := find_implausible(load_rig(path)))} == {}
