"""Files of other programs, written by hand or by their libraries, become a rig."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibgraph import (
    Calibration,
    CalibrationError,
    Rig,
    describe_rig,
    export_calibration,
    import_rig,
    load_rig,
)
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.model.rig import KNOWLEDGE, IntrinsicsSigma
from tests.conftest import KANNALA, RADTAN5, RADTAN8, make_camera, stereo_relative_pose
from tests.io.formats.calibration_files import (
    CAMERA_INFO,
    FRONT,
    KALIBR,
    KOIDE,
    SENSOR_KIT,
    SENTENCE,
    TF2,
    URDF,
    write,
)
from tests.io.formats.conftest import rig_for, varied_rig
from tests.io.kitti_files import written_kitti


@pytest.mark.parametrize(
    "frames",
    [{"car__urdf": URDF}, {"sensor_kit_calibration__yaml": SENSOR_KIT}, {"tf_static__yaml": TF2}],
)
def test_camera_info_and_frames_make_a_rig(frames: dict[str, str], tmp_path: Path) -> None:
    rig = import_rig(write(tmp_path, info__yaml=CAMERA_INFO, **frames))
    camera = rig.cameras["front"]
    np.testing.assert_allclose(camera.T_camera_lidar, FRONT, atol=1e-12)
    assert (camera.model, camera.width_px, camera.height_px) == ("pinhole", 1920, 1200)
    assert tuple(camera.intrinsics_px.model_dump().values()) == (1000.5, 1001.5, 960.25, 600.75)
    assert camera.distortion == (-0.1, 0.02, 0.001, -0.002, 0.003)
    assert describe_rig(rig) == [SENTENCE]


def test_a_camera_link_and_its_optical_frame_are_the_same_camera(tmp_path: Path) -> None:
    files = write(tmp_path, info__yaml=CAMERA_INFO, car__urdf=URDF)
    for frame in ("front_link", "front_camera_optical_frame"):
        rig = import_rig(files, camera_frames={"front": frame})
        np.testing.assert_allclose(rig.T_camera_lidar["front"], FRONT, atol=1e-12)


def test_names_of_cameras_can_be_folders(tmp_path: Path) -> None:
    """ROS names cameras by namespaces, and files are often copies with the same name inside."""
    info = CAMERA_INFO.replace("camera_name: front", "camera_name: stereo/left")
    one, two, kit = write(tmp_path, one__yaml=info, two__yaml=info, kit__yaml=SENSOR_KIT)
    frames = {"stereo_left": "front/camera_link", "right": "front/camera_link"}
    rig = import_rig([one, two, kit], names={two: "right"}, camera_frames=frames)
    assert list(rig.cameras) == ["stereo_left", "right"]


def test_a_camchain_gives_lenses_a_guess_and_relative_poses(tmp_path: Path) -> None:
    rig = import_rig(write(tmp_path, camchain__yaml=KALIBR), relative_sigma_deg=0.2)
    left, right = rig.cameras.values()
    assert list(rig.cameras) == ["cam0", "cam1"]
    assert (left.model, left.distortion) == ("pinhole", (-0.1, 0.02, 0.001, -0.002))
    assert (right.model, right.distortion) == ("fisheye", (0.01, -0.02, 0.003, -0.0004))
    np.testing.assert_allclose(left.T_camera_lidar, FRONT, atol=1e-12)
    # p_right = T_cn_cnm1 p_left: 0.11 m less to the right, so the right camera is at +0.11.
    moved = FRONT.copy()
    moved[0, 3] -= 0.11
    np.testing.assert_allclose(right.T_camera_lidar, moved, atol=1e-12)
    (pair,) = rig.relative_poses
    assert (pair.a, pair.b) == ("cam1", "cam0")
    assert pair.T_a_b[0, 3] == -0.11
    assert pair.rotation_sigma_rad == pytest.approx(np.radians(0.2))
    assert pair.translation_sigma_m == pytest.approx(0.005)
    assert describe_rig(rig)[1:] == [
        "cam1 looks along LiDAR +x, sits 0.40 m ahead, 0.01 m right and 0.20 m below the LiDAR",
        "cam0 sits 0.11 m left of cam1, in the axes of cam1, turned by 0.0 deg against it "
        "(1 sigma: 0.2 deg, 0.5 cm)",
    ]


@pytest.mark.parametrize("way", ["T_lidar_camera", "init_T_lidar_camera"])
def test_koide3_gives_lens_and_result_or_guess(way: str, tmp_path: Path) -> None:
    content = {**KOIDE, "results": {way: KOIDE["results"]["T_lidar_camera"]}}
    (tmp_path / "calib.json").write_text(json.dumps(content))
    rig = import_rig(
        [tmp_path / "calib.json"], names={tmp_path / "calib.json": "front"}, size_px=(1646, 1240)
    )
    np.testing.assert_allclose(rig.T_camera_lidar["front"], FRONT, atol=1e-12)
    assert rig.cameras["front"].distortion == (-0.04, 0.08, 0.0001, -0.0002, -0.03)
    assert describe_rig(rig) == [SENTENCE]


def test_the_result_of_koide3_comes_before_its_guess(tmp_path: Path) -> None:
    (tmp_path / "calib.json").write_text(json.dumps(KOIDE))
    rig = import_rig([tmp_path / "calib.json"], size_px=(1646, 1240))
    np.testing.assert_allclose(rig.T_camera_lidar["calib"], FRONT, atol=1e-12)


@pytest.mark.parametrize("first_line", ["%YAML:1.0\n", "%YAML 1.2\n", ""])
def test_opencv_files_of_any_version_are_read(first_line: str, tmp_path: Path) -> None:
    path = tmp_path / "front.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 1240)
    file.write("image_height", 376)
    file.write("camera_matrix", make_camera().matrix_px)
    file.write("distortion_coefficients", np.array(RADTAN5)[:, None])
    file.release()
    body = path.read_text().partition("\n")[2]
    path.write_text(first_line + body)
    (tmp_path / "kit.yaml").write_text(SENSOR_KIT)
    camera = import_rig([path, tmp_path / "kit.yaml"]).cameras["front"]
    assert camera.intrinsics_px == make_camera().intrinsics_px
    assert camera.distortion == RADTAN5


def test_colmap_lenses_project_as_colmap_does(tmp_path: Path) -> None:
    """COLMAP's pixel (0.5, 0.5) is the centre of the first one."""
    lines = [
        "# Camera list",
        "1 PINHOLE 1240 376 718 710 607 185",
        "2 OPENCV 1240 376 718 710 607 185 -0.11 0.05 0.001 -0.002",
        "3 FULL_OPENCV 1240 376 718 710 607 185 " + " ".join(map(str, RADTAN8)),
        "4 OPENCV_FISHEYE 1240 376 718 710 607 185 " + " ".join(map(str, KANNALA)),
        "5 SIMPLE_RADIAL 1240 376 718 607 185 -0.11",
        "6 RADIAL_FISHEYE 1240 376 718 607 185 0.02 -0.004",
    ]
    tree = "".join(
        f"  camera_{k}/camera_link: {{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}\n"
        for k in range(1, 7)
    )
    kit = f"kit:\n{tree}  lidar: {{x: 0, y: 0, z: 0, roll: 0, pitch: 0, yaw: 0}}\n"
    rig = import_rig(write(tmp_path, cameras__txt="\n".join(lines), kit__yaml=kit))
    rows = {"1": (), "2": (-0.11, 0.05, 0.001, -0.002), "3": RADTAN8, "5": (-0.11, 0, 0, 0)}
    point = np.array([[1.0, 0.5, 10.0]])
    for key, coefficients in rows.items():
        K = np.array([[718, 0, 607], [0, 718 if key == "5" else 710, 185], [0, 0, 1.0]])
        theirs, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, np.array(coefficients))
        ours, _ = rig.cameras[f"camera_{key}"].lens.project(point)
        np.testing.assert_allclose(ours + 0.5, theirs.reshape(1, 2), atol=1e-9)
    for key, fy, coefficients in (("4", 710.0, KANNALA), ("6", 718.0, (0.02, -0.004, 0, 0))):
        K = np.array([[718, 0, 607], [0, fy, 185], [0, 0, 1.0]])
        zero = np.zeros((3, 1))
        theirs, _ = cv2.fisheye.projectPoints(
            point[None], zero, zero, K, np.array(coefficients, dtype=float)
        )
        ours, _ = rig.cameras[f"camera_{key}"].lens.project(point)
        np.testing.assert_allclose(ours + 0.5, theirs.reshape(1, 2), atol=1e-9)


@pytest.mark.parametrize("format", ["kalibr", "tf2", "urdf", "autoware", "opencv"])
def test_what_was_exported_is_imported_again(format: str, tmp_path: Path) -> None:
    rig = rig_for(format)
    path = tmp_path / f"file.{'urdf' if format == 'urdf' else 'yaml'}"
    export_calibration(rig, path, format)
    files = [path]
    if format in ("tf2", "urdf", "autoware"):  # frames alone: with the lenses of a rig
        export_calibration(rig, tmp_path / "lenses.yaml", "opencv")
        text = (tmp_path / "lenses.yaml").read_text().replace("T_camera_lidar:", "other:")
        (tmp_path / "lenses.yaml").write_text(text)
        files.append(tmp_path / "lenses.yaml")
    again = import_rig(files, size_px=(1240, 376))
    assert not again.relative_poses  # what was computed from T_camera_lidar is no measurement
    assert list(again.cameras) == list(rig.cameras)
    for name, camera in rig.cameras.items():
        np.testing.assert_allclose(
            again.T_camera_lidar[name], camera.T_camera_lidar, atol=1e-9, rtol=0
        )
        assert again.cameras[name].intrinsics_px == camera.intrinsics_px
        assert again.cameras[name].width_px == camera.width_px


def test_distorted_lenses_survive_the_way_there_and_back(mixed_rig: Rig, tmp_path: Path) -> None:
    export_calibration(mixed_rig, tmp_path / "rig.yml", "opencv")
    again = import_rig([tmp_path / "rig.yml"])
    for name, camera in mixed_rig.cameras.items():
        assert again.cameras[name].model_dump(exclude={"T_camera_lidar"}) == camera.model_dump(
            exclude={"T_camera_lidar"}
        )


def test_one_frame_serves_all_cameras_of_a_chain(tmp_path: Path) -> None:
    chain = KALIBR.replace("T_cam_lidar", "T_cam_imu")
    files = write(tmp_path, chain__yaml=chain, car__urdf=URDF)
    rig = import_rig(files, camera_frames={"cam0": "front_link"})
    expected = import_rig(write(tmp_path, whole__yaml=KALIBR))
    for name, T in expected.T_camera_lidar.items():
        np.testing.assert_allclose(rig.T_camera_lidar[name], T, atol=1e-12)


def test_a_kitti_sequence_is_imported(tmp_path: Path) -> None:
    folder = written_kitti(tmp_path / "00", frames=1)
    for path in (folder, folder / "calib.txt"):
        rig = import_rig([path])
        expected = load_rig(folder)
        assert list(rig.cameras) == ["image_2", "image_3"]
        for name, T in expected.T_camera_lidar.items():
            np.testing.assert_allclose(rig.T_camera_lidar[name], T, atol=1e-15)


def test_results_and_rig_files_are_imported_with_their_relative_poses(
    solved: Calibration, tmp_path: Path
) -> None:
    solved.save(tmp_path / "result")
    rig = import_rig([tmp_path / "result" / "calibration.yaml"])
    np.testing.assert_allclose(rig.T_camera_lidar["left"], solved.T_camera_lidar["left"])
    tied = Rig(cameras=rig.cameras, relative_poses=(stereo_relative_pose(rig),))
    tied.save(tmp_path / "rig.yaml")
    (pair,) = import_rig([tmp_path / "rig.yaml"]).relative_poses
    assert (pair.rotation_sigma_rad, pair.translation_sigma_m) == (1e-3, 2e-3)
    np.testing.assert_allclose(pair.T_a_b, tied.relative_poses[0].T_a_b, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("side", "side looks along LiDAR +y, 10 deg to the right, sits 0.40 m left and 0.10 m"),
        ("portrait", "portrait looks along LiDAR +x, its image turned by 90 deg, sits 0.40 m"),
    ],
)
def test_sentences_are_what_the_rig_was_made_of(name: str, said: str) -> None:
    (sentence,) = (text for text in describe_rig(varied_rig()) if text.startswith(name))
    assert sentence.startswith(said)


def test_up_and_down_and_the_axis_z_are_in_the_sentences() -> None:
    camera = make_camera()
    for degrees in (20, 50):
        angle = np.radians(degrees)
        pitched = np.eye(4)
        pitched[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        # p' = Rx(angle) p: a point on the old axis appears above, so the camera looks down.
        down = Rig(cameras={"a": camera.moved_to(pitched @ camera.T_camera_lidar)})
        said = f"a looks along LiDAR +x, {degrees} deg down, sits at the LiDAR"
        assert describe_rig(down) == [said]
    floor = Rig(cameras={"a": camera.moved_to(np.diag([1.0, -1, -1, 1]))})
    assert describe_rig(floor) == ["a looks along LiDAR -z, sits at the LiDAR"]


def test_two_files_that_differ_are_refused(tmp_path: Path) -> None:
    other = CAMERA_INFO.replace("1000.5", "1200.5")
    files = write(tmp_path, a__yaml=CAMERA_INFO, b__yaml=other, kit__yaml=SENSOR_KIT)
    with pytest.raises(CalibrationError, match="another lens of camera 'front'"):
        import_rig(files)


LIDAR_TO_CAM = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("suffix", [".txt", ".csv", ".npy"])
def test_a_matrix_is_read_in_the_direction_of_its_name(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"lidar_to_cam{suffix}"
    if suffix == ".npy":
        np.save(path, LIDAR_TO_CAM)
    else:
        np.savetxt(path, LIDAR_TO_CAM, delimiter="," if suffix == ".csv" else " ")
    (lens,) = write(tmp_path, front__yaml=CAMERA_INFO)
    (camera,) = import_rig([lens, path]).cameras.values()
    np.testing.assert_allclose(camera.T_camera_lidar, LIDAR_TO_CAM)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [("echo.txt", "At time 0.0\n- Rotation: in Quaternion (xyzw) [0, 0, 0, 1]\n", "topic echo"),
     ("ost.ini", "[front]\n\ncamera matrix\n480 0 320\n", "give the .yaml"),
     ("rig.ini", "[front]\n", "a file .ini is of no known format; known are those of Kalibr")],
)  # fmt: skip
def test_a_file_of_no_known_format_is_one_short_line(
    name: str, text: str, words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CalibrationError, match=words) as caught:
        import_rig([tmp_path / name])
    assert len(str(caught.value)) < 300 + len(str(tmp_path))


@pytest.mark.parametrize(
    ("joint", "limit", "words"),
    [("revolute", '<limit lower="0.6" upper="2.2"/>', "from 0.6 to 2.2 rad.*outside its limits"),
     ("prismatic", '<limit lower="-1" upper="1"/>', "from -1 to 1 m; it is taken at zero:"),
     ("continuous", "", "can move; it is taken at zero:"),
     ("fixed", "", "")],
)  # fmt: skip
def test_a_joint_that_can_move_is_noted_if_it_lies_between_lidar_and_camera(
    joint: str, limit: str, words: str, tmp_path: Path
) -> None:
    def hung(child: str, parent: str, kind: str = "fixed", more: str = "") -> str:
        return (
            f'<link name="{child}"/><joint name="j_{child}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{child}"/><origin xyz="0 0 1"/>{more}</joint>'
        )

    body = hung("velodyne", "base") + hung("mast", "base", joint, limit)
    body += hung("front_optical_frame", "mast") + hung("wheel", "base", "continuous")
    files = {"front__yaml": CAMERA_INFO, "car__urdf": f"<robot><link name='base'/>{body}</robot>"}
    notes = read_rig_parts(write(tmp_path, **files)).notes
    assert len(notes) == bool(words)
    assert not words or re.search(f"j_mast.*{words}", notes[0])


def test_what_a_rig_states_of_lens_and_times_survives_an_import(tmp_path: Path) -> None:
    """Sigmas and read-out, with which a corrected guess is written again."""
    camera = make_camera().model_copy(
        update={
            "intrinsics_sigma_px": IntrinsicsSigma(focal=3.0, centre=4.0),
            "distortion_sigma": 0.01,
            "time_offset_s": 0.02,
            "time_offset_sigma_s": 0.005,
            "readout_s": 0.03,
            "readout_sigma_s": 0.002,
        }
    )
    Rig(cameras={"front": camera}).save(tmp_path / "rig.yaml")
    found = import_rig([tmp_path / "rig.yaml"]).cameras["front"]
    assert {name: getattr(found, name) for name in KNOWLEDGE} == {
        name: getattr(camera, name) for name in KNOWLEDGE
    }
