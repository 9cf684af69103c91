"""Files that are damaged, incomplete or of lenses that there are not: one line each."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from calibgraph import CalibrationError, FileError, import_rig
from tests.io.formats.calibration_files import (
    CAMERA_INFO,
    KALIBR,
    KOIDE,
    SENSOR_KIT,
    TF2,
    URDF,
    write,
)

OPENCV = """\
%YAML:1.0
---
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 718., 0., 607., 0., 710., 185., 0., 0., 1. ]
image_width: 1240
image_height: 376
"""
COLMAP = "1 PINHOLE 1240 376 718 710 607 185\n"
WHOLE = {
    "camchain.yaml": KALIBR,
    "info.yaml": CAMERA_INFO,
    "car.urdf": URDF,
    "kit.yaml": SENSOR_KIT,
    "tf.yaml": TF2,
    "calib.json": json.dumps(KOIDE, indent=1),
    "front.yml": OPENCV,
    "cameras.txt": COLMAP,
}


def message_of(*paths: Path) -> str:
    """The one line of a refusal."""
    with pytest.raises(CalibrationError) as caught:
        import_rig(paths, size_px=(1240, 376))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("camchain.yaml", "camera_model: pinhole", "camera_model: omni", "after xi: has 3 numbers"),
        ("camchain.yaml", "camera_model: pinhole", "camera_model: eucm", "'eucm' is none of"),
        ("camchain.yaml", "camera_model: pinhole", "camera_model: ds", "'ds' is none of"),
        ("camchain.yaml", "[460.5, 461.5", "[true, 461.5", "expected no truth value"),
        ("camchain.yaml", "radtan", "fov", "lens model 'fov' is none of calibgraph's"),
        ("camchain.yaml", "[460.5, 461.5, 370.25, 240.75]", "[460.5, 461.5]", "intrinsics"),
        ("camchain.yaml", "[460.5,", "[-460.5,", "intrinsics: fx: "),
        ("camchain.yaml", "[0, -1, 0, 0.1]", "[0, 1, 0, 0.1]", "determinant -1"),
        ("camchain.yaml", "[752, 480]", "[752, 0]", "resolution.1"),
        ("camchain.yaml", "-0.002]", "-0.002, 1, 2, 3, 4, 5]", "9 distortion coefficients"),
        ("camchain.yaml", ", -0.002]", "]", "3 distortion coefficients, the lens"),
        ("info.yaml", "plumb_bob", "thin_prism", "'thin_prism' is none of"),
        ("info.yaml", "1000.5, 0,", "1000.5,", "has 3 rows, 3 columns and 8 numbers"),
        ("info.yaml", "image_height: 1200", "", "the height of the image is missing"),
        ("car.urdf", "<robot", "<!DOCTYPE x><robot", "is not a URDF"),
        ("car.urdf", "</robot>", "", "is not a URDF"),
        ("car.urdf", "1.0 0.0 2.0", "1.0 2.0", "joint 'a': expected three numbers"),
        ("car.urdf", "1.0 0.0 2.0", "1.0 nan 2.0", "is not finite"),
        ("car.urdf", '<parent link="base_link"/>', "", "joint 'a' has no <parent>"),
        ("car.urdf", 'child link="front_link"', 'child link="velodyne"', "has two parents"),
        ("car.urdf", '"base_link"/><child link="velodyne"', '"velodyne"/><child link="velodyne"',
         "its own ancestor"),
        ("car.urdf", 'child link="velodyne"', 'child link="radar"', "frame of the LiDAR"),
        ("kit.yaml", "yaw: 0.0}", "yo: 0.0}", "front/camera_link: unknown key 'yo'"),
        ("kit.yaml", "x: 0.4", "x: far", "front/camera_link: x: "),
        ("kit.yaml", "gnss_link", "livox_left", "could be livox_left, velodyne_top_base_link"),
        ("tf.yaml", "w: 0.5", "v: 0.5", "rotation.w' is missing"),
        ("tf.yaml", "frame_id: base_link", "frame_id: odom", "no lens"),
        ("calib.json", "plumb_bob", "equirectangular", "expected width and height"),
        ("calib.json", "plumb_bob", "atan", "'atan' is none of"),
        ("calib.json", '"T_lidar_camera": [', '"T_lidar_camera": [[', "is not valid JSON"),
        ("calib.json", '"intrinsics": [', '"intrinsics": [1,', "intrinsics"),
        ("front.yml", "cols: 3", "cols: 4", "3 rows, 4 columns and 9 numbers"),
        ("front.yml", "camera_matrix", "matrix", "holds no camera matrix"),
        ("front.yml", "718.", ".nan", "camera_matrix: expected finite numbers"),
        ("cameras.txt", "PINHOLE", "THIN_PRISM_FISHEYE", "line 1: lens model 'THIN_PRISM_FISHEYE'"),
        ("cameras.txt", " 185", "", "PINHOLE has 4 parameters"),
        ("cameras.txt", "1240", "wide", "line 1: expected CAMERA_ID"),
        ("cameras.txt", COLMAP, "# none\n", "holds no camera"),
    ],
)  # fmt: skip
def test_damaged_files_are_one_line(
    name: str, old: str, new: str, said: str, tmp_path: Path
) -> None:
    assert old in WHOLE[name]
    (tmp_path / name).write_text(WHOLE[name].replace(old, new, 1))
    files = [tmp_path / name]
    if name in ("car.urdf", "kit.yaml"):
        files += write(tmp_path, lens__yaml=CAMERA_INFO)
    message = message_of(*files)
    assert said in message
    if "lens" not in said and "frame" not in said and "ancestor" not in said:
        assert name in message or "parents" in said or "could be" in said


def test_a_zero_quaternion_of_koide3_is_one_line(tmp_path: Path) -> None:
    content = {**KOIDE, "results": {"T_lidar_camera": [0.0] * 7}}
    (tmp_path / "calib.json").write_text(json.dumps(content))
    assert "calib.json: camera: T_lidar_camera" in message_of(tmp_path / "calib.json")


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    (info,) = write(tmp_path, info__yaml=CAMERA_INFO)
    assert "camera 'front': no file has its T_camera_lidar; name its frame" in message_of(info)
    (tmp_path / "calib.json").write_text(json.dumps(KOIDE))
    with pytest.raises(CalibrationError, match="no image size; give it with --size"):
        import_rig([tmp_path / "calib.json"])
    (kit,) = write(tmp_path, kit__yaml=SENSOR_KIT)
    assert "no lens; add the file with the intrinsics" in message_of(kit)
    with pytest.raises(CalibrationError, match="no frame 'front_cam'; there are base_link"):
        import_rig([info, *write(tmp_path, car__urdf=URDF)], camera_frames={"front": "front_cam"})
    island = (
        SENSOR_KIT.replace("sensor_kit_base_link", "other")
        + "car:\n  radar: "
        + ("{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}\n")
    )
    files = [info, *write(tmp_path, island__yaml=island)]
    with pytest.raises(CalibrationError, match="are not connected: their roots are"):
        import_rig(files, lidar_frame="radar")


def test_two_cameras_of_one_name_are_refused(tmp_path: Path) -> None:
    body = OPENCV.partition("---\n")[2]
    camera = "name: front\n" + body
    nested = "".join(
        f"{key}:\n" + "".join(f"   {line}\n" for line in camera.splitlines()) for key in "ab"
    )
    (path,) = write(tmp_path, rig__yml="%YAML:1.0\n---\n" + nested)
    assert "gives two cameras the name 'front'" in message_of(path)
    renamed = KALIBR.replace("cam1:", "cam1:\n  calibgraph: {camera: cam0}")
    (path,) = write(tmp_path, chain__yaml=renamed)
    assert "two cameras have one name" in message_of(path)


def test_unknown_and_unexpanded_files_are_named(tmp_path: Path) -> None:
    macro = URDF.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"').replace(
        "<link name=\"base_link\"/>", '<xacro:property name="x" value="1"/>'
    )  # fmt: skip
    (xacro,) = write(tmp_path, car__xacro=macro)
    assert "expand it: xacro FILE > robot.urdf" in message_of(xacro)
    (other,) = write(tmp_path, a__yaml="speed: 3\n")
    assert "its keys (speed) are of no known format; known are those of Kalibr" in message_of(other)
    (other,) = write(tmp_path, a__csv="1,2\n")
    assert "its line '1,2' is of no known format" in message_of(other)
    assert "no such file" in message_of(tmp_path / "nothing.yaml")
    (bomb,) = write(
        tmp_path,
        bomb__urdf='<!DOCTYPE r [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><robot>&b;</robot>',
    )
    assert "is not a URDF" in message_of(bomb)


@pytest.mark.parametrize("name", WHOLE)
def test_no_damage_ends_in_another_error(name: str, tmp_path: Path) -> None:
    """Cut anywhere, or with bytes changed, a file is read or refused in one line."""
    rng = np.random.default_rng(0)
    whole = WHOLE[name].encode()
    path = tmp_path / name
    (lens,) = write(tmp_path, lens__yaml=CAMERA_INFO.replace("front", "lens"))
    refused = 0
    for trial in range(60):
        damaged = bytearray(whole[: rng.integers(len(whole))] if trial % 2 else whole)
        for place in rng.integers(0, max(len(damaged), 1), 3 if damaged else 0):
            damaged[place] = rng.integers(256) if trial % 3 else rng.choice(list(b"0-{[}]:<>&\n"))
        path.write_bytes(bytes(damaged))
        try:
            import_rig([path, lens], size_px=(10, 10))
        except FileError as error:
            assert str(error).startswith(str(tmp_path)) and "\n" not in str(error)
            refused += 1
        except CalibrationError as error:
            assert not re.search("[\n\r]", str(error))
            refused += 1
    assert refused > 20
