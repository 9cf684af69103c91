from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calibgraph import (
    FileError,
    Rig,
    load_rig,
)
from calibgraph.model.rig import rigid_transform
from tests.conftest import stereo_relative_pose
from tests.model.rig_files import written


def test_a_rig_file_returns_the_same_rig(pair: Rig, tmp_path: Path) -> None:
    rig = pair.model_copy(update={"relative_poses": (stereo_relative_pose(pair),)})
    rig.save(tmp_path / "rig.yaml")
    loaded = load_rig(tmp_path / "rig.yaml")
    assert loaded.model_dump_json() == rig.model_dump_json()


def turned(T: np.ndarray) -> list[list[float]]:
    mirrored = T.copy()
    mirrored[0] *= -1
    return mirrored.tolist()


BAD = {
    "unknown key": ({"fov": 90}, r"unknown key 'cameras.left.fov'"),
    "no such model": ({"model": "omni"}, r"model.*omni"),
    "focal length": (
        {"intrinsics_px": {"fx": -1, "fy": 700, "cx": 1, "cy": 1}},
        r"intrinsics_px.fx.*-1",
    ),
    "text for a number": (
        {"intrinsics_px": {"fx": "wide", "fy": 700, "cx": 1, "cy": 1}},
        r"fx.*'wide'",
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
    "ragged": ({"T_camera_lidar": [[1, 0], [0]]}, r"4x4"),
    "not a rotation": ({"T_camera_lidar": (2 * np.eye(4)).tolist()}, r"last row"),
    "scaled": ({"T_camera_lidar": np.diag([2.0, 2, 2, 1]).tolist()}, r"not a rotation"),
    "mirrored": ({"T_camera_lidar": turned(np.eye(4))}, r"determinant -1"),
    "distortion": (
        {"distortion": [0.1, 0.2]},
        r"2 distortion coefficients found, expected 0, 4, 5, 8: .*\[k1, k2, p1, p2, k3\]",
    ),
    "lens of ROS": ({"model": "plumb_bob"}, r"called 'pinhole' here; .*k1, k2, p1, p2"),
    "lens of Kalibr": (
        {"model": "equidistant"},
        r"called 'fisheye' here; its distortion is \[k1, k2, k3, k4\]",
    ),
    "unknown lens": ({"model": "ds"}, r"'omnidirectional' or 'equirectangular', found 'ds'"),
    "mirror": (
        {"model": "omnidirectional", "distortion": [-1, 0, 0, 0, 0]},
        r"xi of the unified model is -1, expected 0 to 100",
    ),
    "panorama": (
        {"model": "equirectangular", "distortion": [0.1, 0, 0, 0]},
        r"4 distortion coefficients found, expected 0",
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


UNSEEN = [
    "a\x7fb",
    "a\x1b[2Jb",
    "a\x85b",
    "a\x9b2Jb",
    "a\u202eb",
    "a\u2066b",
    "a\u200bb",
    "a\ud800b",
]


@pytest.mark.parametrize(
    "name", ["", ".", "..", "../../up", "a/b", "a\\b", "a\nb", "x" * 101, *UNSEEN]
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
