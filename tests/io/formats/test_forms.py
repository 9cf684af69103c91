"""Forms in which people have their calibrations: each is read, with the direction that it states.

The camera is FRONT of test_import: 0.4 m ahead of the LiDAR, 0.1 m left and 0.2 m below it, looking
ahead. By hand: the point 10.4 m ahead, 0.9 m to the right and 2.2 m below the LiDAR is 10 m ahead,
1 m to the right and 2 m below the camera.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from calibgraph import Rig, export_calibration, import_rig, load_rig
from calibgraph.errors import CalibrationError
from calibgraph.io.formats.rig_import import read_rig_parts
from tests.conftest import RADTAN5, make_camera
from tests.io.formats.calibration_files import CAMERA_INFO, FRONT, SENSOR_KIT, URDF, write
from tests.io.formats.conftest import rig_for

P_LIDAR, P_CAMERA = [10.4, -0.9, -2.2, 1.0], [1.0, 2.0, 10.0]
T_LIDAR_CAMERA = np.linalg.inv(FRONT)
T_IMU_LIDAR = np.eye(4)
T_IMU_LIDAR[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
T_IMU_LIDAR[:3, 3] = 0.5, 0.0, 0.1
T_IMU_CAMERA = T_IMU_LIDAR @ T_LIDAR_CAMERA
LENS = {"image_width": 640, "image_height": 360, "camera_matrix": {
    "rows": 3, "cols": 3, "data": [480.0, 0, 320, 0, 481, 180, 0, 0, 1]}}  # fmt: skip
OPENCV_LENS = "".join(f"{key}: {json.dumps(value)}\n" for key, value in LENS.items())


def matrix(T: np.ndarray) -> dict[str, Any]:
    return {"rows": len(T), "cols": T.shape[1], "dt": "d", "data": T.ravel().tolist()}


def saved(path: Path, content: Any, first: str = "") -> Path:
    text = json.dumps(content) if path.suffix == ".json" else yaml.safe_dump(content)
    path.write_text(first + text)
    return path


def assert_front(rig: Rig, name: str = "front") -> None:
    """The camera sees the point worked by hand where it has to."""
    found = rig.T_camera_lidar[name] @ P_LIDAR
    np.testing.assert_allclose(found[:3], P_CAMERA, atol=1e-6)


MESSAGE = {
    "header": {"stamp": {"sec": 3, "nanosec": 4}, "frame_id": "front_optical_frame"},
    "height": 360, "width": 640, "distortion_model": "plumb_bob", "d": [0.1, 0.0, 0.0, 0.0, 0.0],
    "k": [480.0, 0.0, 320.0, 0.0, 481.0, 180.0, 0.0, 0.0, 1.0],
    "r": np.eye(3).ravel().tolist(), "p": [470.0, 0, 320, 0, 0, 470, 180, 0, 0, 0, 1, 0],
    "binning_x": 0, "binning_y": 0,
    "roi": {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False},
}  # fmt: skip
ROS_1 = {key.upper() if len(key) == 1 else key: value for key, value in MESSAGE.items()}
STAMPED = {
    "header": {"seq": 0, "frame_id": "velodyne"},
    "child_frame_id": "front_optical_frame",
    "transform": {
        "translation": dict(zip("xyz", [0.4, 0.1, -0.2], strict=True)),
        "rotation": dict(zip("xyzw", [-0.5, 0.5, -0.5, 0.5], strict=True)),
    },
}
OTHER = {**STAMPED, "child_frame_id": "gnss"}


def documents(*contents: Any) -> str:
    return "".join(yaml.safe_dump(each, sort_keys=False) + "---\n" for each in contents)


@pytest.mark.parametrize(
    "info",
    [
        documents(MESSAGE),
        documents(ROS_1, {**ROS_1, "header": {"frame_id": "front_optical_frame", "seq": 5}}),
        yaml.safe_dump({key: MESSAGE[key] for key in MESSAGE if key != "roi"}),
    ],
    ids=["echo", "repeated", "once"],
)
@pytest.mark.parametrize(
    "frames",
    [
        documents({"transforms": [STAMPED, OTHER]}),
        documents({"transforms": [STAMPED]}, {"transforms": [OTHER]}, {"transforms": [STAMPED]}),
        yaml.safe_dump(STAMPED),
        documents(STAMPED, OTHER),
    ],
    ids=["echo", "several", "Apollo", "stamped"],
)
def test_what_ros_prints_is_read(info: str, frames: str, tmp_path: Path) -> None:
    files = write(tmp_path, front__yaml=info, tf_static__yaml=frames)
    rig = import_rig(files)
    assert_front(rig)
    camera = rig.cameras["front"]
    assert tuple(camera.intrinsics_px.model_dump().values()) == (480, 481, 320, 180)
    assert camera.distortion[0] == 0.1


def test_the_frame_of_a_camera_info_names_the_camera_in_the_tree(tmp_path: Path) -> None:
    files = write(tmp_path, left__yaml=documents(MESSAGE), tf__yaml=documents(STAMPED))
    assert_front(import_rig(files), "left")


def test_binning_and_window_of_a_printed_camera_info_count(tmp_path: Path) -> None:
    window = {"x_offset": 20, "y_offset": 0, "width": 600, "height": 360}
    message = {**MESSAGE, "binning_x": 2, "binning_y": 2, "roi": window}
    files = write(tmp_path, front__yaml=documents(message), tf__yaml=documents(STAMPED))
    camera = import_rig(files).cameras["front"]
    assert (camera.width_px, camera.height_px, camera.intrinsics_px.cx) == (300, 180, 150)


def test_camera_infos_that_differ_are_refused(tmp_path: Path) -> None:
    other = {**MESSAGE, "width": 1280}
    (path,) = write(tmp_path, front__yaml=documents(MESSAGE, other))
    with pytest.raises(CalibrationError, match="holds 2 different YAML documents; keep one"):
        import_rig([path])


@pytest.mark.parametrize("key", ["camera_model", "distortion_model", None])
def test_camera_info_files_of_all_releases_of_ros_are_read(key: str | None, tmp_path: Path) -> None:
    """Melodic's have camera_model in place of distortion_model, older ones have neither."""
    line = "" if key is None else f"{key}: plumb_bob\n"
    info = CAMERA_INFO.replace("distortion_model: plumb_bob\n", line)
    rig = import_rig(write(tmp_path, info__yaml=info, car__urdf=URDF))
    assert_front(rig)
    assert rig.cameras["front"].distortion == (-0.1, 0.02, 0.001, -0.002, 0.003)


VINS = {
    "model_type": "PINHOLE", "camera_name": "front", "image_width": 640, "image_height": 360,
    "distortion_parameters": {"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3},
    "projection_parameters": {"fx": 480.0, "fy": 481.0, "cx": 320.0, "cy": 180.0},
    "estimate_extrinsic": 0,
    "extrinsicRotation": matrix(T_IMU_CAMERA[:3, :3]),
    "extrinsicTranslation": matrix(T_IMU_CAMERA[:3, 3:]),
}  # fmt: skip
LIO = {"mapping": {"extrinsic_T": T_IMU_LIDAR[:3, 3].tolist(),
                   "extrinsic_R": T_IMU_LIDAR[:3, :3].ravel().tolist()}}  # fmt: skip


def test_the_cameras_of_vins_are_tied_to_the_lidar_through_the_imu(tmp_path: Path) -> None:
    vins = saved(tmp_path / "config.yaml", VINS, "%YAML:1.0\n---\n")
    rig = import_rig([vins, saved(tmp_path / "fast_lio.yaml", LIO)])
    assert_front(rig)
    assert rig.cameras["front"].distortion == (-0.2, 0.05, 1e-3, -2e-3)
    assert_front(import_rig([vins, tmp_path / "fast_lio.yaml"], rename={"front": "left"}), "left")


def test_kalibr_s_cameras_in_the_imu_are_tied_to_the_lidar(tmp_path: Path) -> None:
    chain = {"cam0": {
        "camera_model": "pinhole", "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4,
        "intrinsics": [480.0, 481.0, 320.0, 180.0], "resolution": [640, 360],
        "T_cam_imu": np.linalg.inv(T_IMU_CAMERA).tolist()}}  # fmt: skip
    files = [saved(tmp_path / "camchain.yaml", chain), saved(tmp_path / "lio.yaml", LIO)]
    assert_front(import_rig(files), "cam0")
    assert_front(import_rig(files, rename={"cam0": "left"}), "left")


def test_cameras_in_an_imu_without_a_lidar_do_not_stand_in_the_way(tmp_path: Path) -> None:
    vins = saved(tmp_path / "front.yaml", VINS)
    with pytest.raises(CalibrationError, match="as no file has the LiDAR in the IMU"):
        import_rig([vins])
    kit = write(tmp_path, kit__yaml=SENSOR_KIT)
    assert_front(import_rig([vins, *kit]))


def test_vins_fusion_has_the_pose_of_each_camera_in_the_body(tmp_path: Path) -> None:
    fusion = {"imu": 1, "num_of_cam": 1, "body_T_cam0": matrix(T_IMU_CAMERA), "cam0_calib": "a"}
    lens = {key: value for key, value in VINS.items() if not key.startswith("extrinsic")}
    files = [saved(tmp_path / "cam0.yaml", lens), saved(tmp_path / "f.yaml", fusion),
             saved(tmp_path / "lio.yaml", LIO)]  # fmt: skip
    assert_front(import_rig(files, names={files[0]: "cam0"}), "cam0")


@pytest.mark.parametrize(
    ("lens", "model", "distortion"),
    [
        ({"model_type": "KANNALA_BRANDT",
          "projection_parameters": {"k2": 0.1, "k3": -0.02, "k4": 0.004, "k5": -1e-3, "mu": 480.0,
                                    "mv": 481.0, "u0": 320.0, "v0": 180.0}},
         "fisheye", (0.1, -0.02, 0.004, -1e-3)),
        ({"model_type": "MEI", "mirror_parameters": {"xi": 1.2},
          "distortion_parameters": {"k1": -0.2, "k2": 0.05, "p1": 1e-3, "p2": -2e-3},
          "projection_parameters": {"gamma1": 480.0, "gamma2": 481.0, "u0": 320.0, "v0": 180.0}},
         "omnidirectional", (1.2, -0.2, 0.05, 1e-3, -2e-3)),
    ],
)  # fmt: skip
def test_camodocal_s_wide_lenses_are_read(
    lens: dict[str, Any], model: str, distortion: tuple[float, ...], tmp_path: Path
) -> None:
    """KITTI-360's image_02.yaml is of this form, too."""
    pinhole = ("distortion_parameters", "projection_parameters")
    kept = {key: value for key, value in VINS.items() if key not in pinhole}
    files = [saved(tmp_path / "a.yaml", {**kept, **lens}), saved(tmp_path / "l.yaml", LIO)]
    camera = import_rig(files).cameras["front"]
    assert (camera.model, camera.distortion) == (model, distortion)
    assert tuple(camera.intrinsics_px.model_dump().values()) == (480, 481, 320, 180)


VIKIT = {
    "cam_model": "Pinhole", "cam_width": 640, "cam_height": 360, "scale": 0.5, "cam_fx": 480.0,
    "cam_fy": 481.0, "cam_cx": 320.0, "cam_cy": 180.0,
    "cam_d0": -0.07, "cam_d1": 0.12, "cam_d2": -1e-3, "cam_d3": 2e-4,
}  # fmt: skip
LIVO = {"Rcl": FRONT[:3, :3].ravel().tolist(), "Pcl": FRONT[:3, 3].tolist()}


@pytest.mark.parametrize(
    "parameters",
    [
        {"camera": LIVO},
        {"extrin_calib": {**LIO["mapping"], **LIVO}},
        {"/**": {"ros__parameters": {"extrin_calib": {**LIO["mapping"], **LIVO}}}},
    ],
)
def test_fast_livo_is_read_in_two_files(parameters: dict[str, Any], tmp_path: Path) -> None:
    files = [saved(tmp_path / "avia.yaml", parameters), saved(tmp_path / "front.yaml", VIKIT)]
    rig = import_rig(files)
    assert_front(rig)
    assert rig.cameras["front"].distortion == (-0.07, 0.12, -1e-3, 2e-4)


def test_a_fisheye_of_fast_livo_has_its_own_names(tmp_path: Path) -> None:
    lens = {key: value for key, value in VIKIT.items() if not key.startswith("cam_d")}
    lens |= {"cam_model": "EquidistantCamera", "k1": -0.05, "k2": 0.01, "k3": 0.0, "k4": 1e-3}
    files = [saved(tmp_path / "a.yaml", {"c": LIVO}), saved(tmp_path / "front.yaml", lens)]
    camera = import_rig(files).cameras["front"]
    assert (camera.model, camera.distortion) == ("fisheye", (-0.05, 0.01, 0.0, 1e-3))


@pytest.mark.parametrize("key", ["Tbc", "IMU.T_b_c1"])
def test_orb_slam_has_the_pose_of_its_camera_in_the_imu(key: str, tmp_path: Path) -> None:
    content = {
        "Camera.type": "KannalaBrandt8", "Camera1.fx": 480.0, "Camera1.fy": 481.0,
        "Camera1.cx": 320.0, "Camera1.cy": 180.0, "Camera1.k1": 0.01, "Camera1.k2": 0.0,
        "Camera1.k3": 0.002, "Camera1.k4": 0.0, "Camera.width": 640, "Camera.height": 360,
        key: matrix(T_IMU_CAMERA),
    }  # fmt: skip
    path = saved(tmp_path / "front.yaml", content, "%YAML:1.0\n---\n")
    rig = import_rig([path, saved(tmp_path / "lio.yaml", LIO)])
    assert_front(rig)
    assert rig.cameras["front"].distortion == (0.01, 0.0, 0.002, 0.0)


def test_lvi_sam_s_lidar_to_cam_is_left_out_and_said_so(tmp_path: Path) -> None:
    path = saved(tmp_path / "params_camera.yaml", {**VINS, "lidar_to_cam_tx": 0.05})
    (note,) = read_rig_parts([path, saved(tmp_path / "l.yaml", LIO)]).notes
    assert "params_camera.yaml: lidar_to_cam_tx is not read" in note


BASALT = {"value0": {
    "T_imu_cam": [
        {**dict(zip(("px", "py", "pz"), T_IMU_CAMERA[:3, 3], strict=True)),
         **dict(zip(("qx", "qy", "qz", "qw"),
                    Rotation.from_matrix(T_IMU_CAMERA[:3, :3]).as_quat().tolist(), strict=True))}],
    "intrinsics": [{"camera_type": "kb4", "intrinsics": {
        "fx": 480.0, "fy": 481.0, "cx": 320.0, "cy": 180.0,
        "k1": 0.01, "k2": -0.02, "k3": 0.003, "k4": 0.0}}],
    "resolution": [[640, 360]], "calib_accel_bias": [0.0] * 9}}  # fmt: skip


def test_basalt_has_the_pose_of_each_camera_in_the_imu(tmp_path: Path) -> None:
    files = [saved(tmp_path / "basalt.json", BASALT), saved(tmp_path / "lio.yaml", LIO)]
    rig = import_rig(files)
    assert_front(rig, "cam0")
    assert (rig.cameras["cam0"].model, rig.cameras["cam0"].distortion[1]) == ("fisheye", -0.02)
    other = json.loads(json.dumps(BASALT).replace("kb4", "ds"))
    with pytest.raises(CalibrationError, match="lens model 'ds' is none of calibgraph's"):
        import_rig([saved(tmp_path / "basalt.json", other)])


def test_json_of_no_known_program_is_named_by_its_keys(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.json", {"version": 3, "speed": {"max": 2}})
    with pytest.raises(CalibrationError, match=r"its keys \(version, speed\) are of no known"):
        import_rig([path])
    (tmp_path / "list.json").write_text("[1, 2]")
    with pytest.raises(CalibrationError, match="holds .1, 2., expected an object"):
        import_rig([tmp_path / "list.json"])


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_writes_the_same_in_three_languages(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"front{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 1240)
    file.write("image_height", 376)
    file.write("camera_matrix", make_camera().matrix_px)
    file.write("model", "pinhole")
    file.write("distortion_coefficients", np.array(RADTAN5)[:, None])
    file.write("T_camera_lidar", FRONT)
    file.release()
    rig = import_rig([path])
    assert_front(rig)
    assert rig.cameras["front"].intrinsics_px == make_camera().intrinsics_px
    assert rig.cameras["front"].distortion == RADTAN5


def test_a_json_export_is_a_rig(mixed_rig: Rig, tmp_path: Path) -> None:
    for rig in (mixed_rig, rig_for("json")):
        export_calibration(rig, tmp_path / "rig.json", "json", force=True)
        for read in (load_rig(tmp_path / "rig.json"), import_rig([tmp_path / "rig.json"])):
            assert list(read.cameras) == list(rig.cameras)
            for name, camera in rig.cameras.items():
                found = read.cameras[name]
                lens = ("model", "distortion", "intrinsics_px", "width_px", "height_px")
                assert all(getattr(found, key) == getattr(camera, key) for key in lens)
                np.testing.assert_allclose(found.T_camera_lidar, camera.T_camera_lidar, atol=1e-12)


def row(T: np.ndarray) -> str:
    return " ".join(f"{value:.9f}" for value in T[:3].ravel())


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("cam_to_velo.txt", row(T_LIDAR_CAMERA) + "\n"),
        ("calib_front_cam2velo.txt", row(T_LIDAR_CAMERA) + " 0 0 0 1\n"),
        ("velo_to_cam.txt", "\n".join(row(FRONT[i : i + 1]) for i in range(3))),
        ("calib_velo_to_cam.txt", "calib_time: 15-Mar-2012 11:37:16\nR: " + " ".join(
            map(str, FRONT[:3, :3].ravel())) + "\nT: " + " ".join(map(str, FRONT[:3, 3]))),
    ],
)  # fmt: skip
def test_matrices_in_text_files_have_the_direction_of_their_name(
    name: str, text: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    lens = saved(tmp_path / "front.yaml", LENS)
    assert_front(import_rig([lens, tmp_path / name]))


def test_a_matrix_whose_file_states_no_direction_is_a_question(tmp_path: Path) -> None:
    (tmp_path / "extrinsic.txt").write_text(row(FRONT))
    with pytest.raises(CalibrationError, match="its name states no direction; name the file"):
        import_rig([tmp_path / "extrinsic.txt"])


@pytest.mark.parametrize("text", ["At time 0.0\n- Translation: [1, 2, 3]\n", "hello\n", ""])
def test_other_text_is_of_no_known_format(text: str, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text(text)
    with pytest.raises(CalibrationError, match="is of no known format; known are those of Kalibr"):
        import_rig([tmp_path / "notes.txt"])


def test_kitti_360_is_read_through_its_rectification(tmp_path: Path) -> None:
    rectify = np.eye(4)
    rectify[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.3, 0.5], degrees=True).as_matrix()
    T_cam_velo = rectify.T @ FRONT  # so that the rectified camera is FRONT
    T_pose_cam = np.eye(4)
    T_pose_cam[:3, 3] = 1.5, 0.3, 1.0
    beside = T_pose_cam.copy()
    beside[0, 3] += 0.6
    P = "552.5 0 682.0 {} 0 552.5 238.8 0 0 0 1 0"
    R = " ".join(f"{value:.12f}" for value in rectify[:3, :3].ravel())
    lines = [f"{key}_0{k}: {value}" for k in (0, 1) for key, value in (
        ("S_rect", "1408 376"), ("R_rect", R), ("P_rect", P.format(-331.5 * k)))]  # fmt: skip
    (tmp_path / "perspective.txt").write_text("\n".join(["calib_time: 9", *lines]))
    (tmp_path / "calib_cam_to_velo.txt").write_text(row(np.linalg.inv(T_cam_velo)))
    poses = (f"image_0{k}: {row(T)}\n" for k, T in enumerate((T_pose_cam, beside)))
    (tmp_path / "calib_cam_to_pose.txt").write_text("".join(poses))
    names = ("perspective", "calib_cam_to_velo", "calib_cam_to_pose")
    rig = import_rig([tmp_path / f"{name}.txt" for name in names])
    assert_front(rig, "image_00")
    # P is K [I | b] with b = -331.5 px / 552.5 px = -0.6 m: 1 m to the right is 0.4 m there.
    found = rig.T_camera_lidar["image_01"] @ P_LIDAR
    np.testing.assert_allclose(found[:3], [0.4, 2.0, 10.0], atol=1e-6)
    assert rig.cameras["image_01"].width_px == 1408
    without_poses = import_rig([tmp_path / f"{name}.txt" for name in names[:2]])
    assert list(without_poses.cameras) == ["image_00", "image_01"]


def test_a_fisheye_of_kitti_360_is_in_its_place_by_the_poses(tmp_path: Path) -> None:
    T_pose_cam, beside = np.eye(4), np.eye(4)
    beside[0, 3] = 0.5  # along x of the first camera, whose axes it has
    (tmp_path / "calib_cam_to_velo.txt").write_text(row(T_LIDAR_CAMERA))
    poses = f"image_00: {row(T_pose_cam)}\nimage_02: {row(beside)}\n"
    (tmp_path / "calib_cam_to_pose.txt").write_text(poses)
    lens = {
        **VINS,
        "model_type": "MEI",
        "mirror_parameters": {"xi": 2.2},
        "camera_name": "image_02",
        "projection_parameters": {"gamma1": 1336.0, "gamma2": 1335.0, "u0": 716.0, "v0": 705.0},
    }
    lens = {key: value for key, value in lens.items() if not key.startswith("extrinsic")}
    files = [tmp_path / "calib_cam_to_velo.txt", tmp_path / "calib_cam_to_pose.txt"]
    rig = import_rig([saved(tmp_path / "image_02.yaml", lens, "%YAML:1.0\n---\n"), *files])
    found = rig.T_camera_lidar["image_02"] @ P_LIDAR
    np.testing.assert_allclose(found[:3], [0.5, 2.0, 10.0], atol=1e-6)
    assert rig.cameras["image_02"].distortion[0] == 2.2


@pytest.mark.parametrize("bad", [{"w": 0.0}, {"w": float("nan")}, {"x": 3.0}])
def test_a_frame_without_rotation_that_no_camera_needs_is_left_out(
    bad: dict[str, float], tmp_path: Path
) -> None:
    rotation = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0, **bad}
    broken = {**OTHER, "transform": {**OTHER["transform"], "rotation": rotation}}
    files = write(tmp_path, front__yaml=documents(MESSAGE),
                  tf__yaml=documents({"transforms": [broken, STAMPED]}))  # fmt: skip
    assert_front(import_rig(files))
    (note,) = read_rig_parts(files).notes
    assert "frame 'gnss' is left out: quaternion" in note
    broken = {**broken, "child_frame_id": "front_optical_frame"}
    files = write(tmp_path, front__yaml=documents(MESSAGE), tf__yaml=documents(broken, OTHER))
    with pytest.raises(CalibrationError, match="frame 'front_optical_frame' is left out: quat"):
        import_rig(files)


def test_an_extrinsic_of_no_named_camera_asks_for_its_name(tmp_path: Path) -> None:
    lens = {
        "image_size": [640, 360],
        "K": [[480, 0, 320], [0, 481, 180], [0, 0, 1]],
        "dist": [0.1, 0, 0, 0, 0],
    }
    both = {"a": lens, "b": dict(lens)}
    files = [saved(tmp_path / "lens.json", both), saved(tmp_path / "livo.yaml", LIVO)]
    with pytest.raises(CalibrationError, match="names no camera; there are a, b: give it as NAME"):
        import_rig(files)
