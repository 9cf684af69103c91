"""Every exported file, read by an independent reader."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
from urdf_parser_py.urdf import URDF

from calibgraph import (
    Calibration,
    CalibrationError,
    FileError,
    Rig,
    export_calibration,
    load_rig,
)
from calibgraph.io.formats.export import WRITERS
from calibgraph.io.formats.names import EXPORT_FORMATS
from tests.conftest import make_pair
from tests.io.formats.conftest import rig_for, varied_rig
from tests.io.formats.readers import READERS, angles_pose, worked_points

LIDAR_POSE = angles_pose([1.2, -0.1, 1.9], 0.02, -0.03, 1.4)


def exported_text(path: Path) -> str:
    """The text of a file and of the one beside it."""
    beside = path.with_name(f"{path.stem}.direction.txt")
    return path.read_text() + (beside.read_text() if beside.exists() else "")


def test_each_format_has_a_meaning_a_writer_and_an_independent_reader() -> None:
    assert set(EXPORT_FORMATS) == set(WRITERS) == {*READERS, "camera_info"}  # has no extrinsics


@pytest.mark.parametrize("format", READERS)
def test_an_independent_reader_finds_the_same_extrinsics(format: str, tmp_path: Path) -> None:
    rig = rig_for(format)
    path = tmp_path / "file.txt"
    export_calibration(rig, path, format)
    found = READERS[format](path)
    assert set(found) == set(rig.cameras)
    for name, T in rig.T_camera_lidar.items():
        np.testing.assert_allclose(found[name], T, atol=1e-9, rtol=0)


@pytest.mark.parametrize("format", READERS)
def test_the_worked_point_proves_the_direction(format: str, tmp_path: Path) -> None:
    rig = rig_for(format)
    path = tmp_path / "file.txt"
    export_calibration(rig, path, format)
    points = worked_points(exported_text(path))
    assert set(points) == set(rig.cameras)
    for name, T in READERS[format](path).items():
        p_lidar, p_camera = points[name]
        # Six digits are printed: half a unit of the last is the largest error.
        np.testing.assert_allclose((T @ [*p_lidar, 1])[:3], p_camera, atol=5.1e-7)
        assert np.abs((np.linalg.inv(T) @ [*p_lidar, 1])[:3] - p_camera).max() > 0.1


def test_the_lidars_mounting_moves_sensors_together(tmp_path: Path) -> None:
    rig = varied_rig()
    export_calibration(rig, tmp_path / "file.txt", "autoware", T_base_lidar=LIDAR_POSE)
    text = (tmp_path / "file.txt").read_text()
    assert "--lidar-pose puts it" in text
    pose = yaml.safe_load(text)["sensor_kit_base_link"]["lidar"]
    assert [pose[key] for key in ("x", "y", "z", "yaw")] == pytest.approx([1.2, -0.1, 1.9, 1.4])
    for name, T in READERS["autoware"](tmp_path / "file.txt").items():
        np.testing.assert_allclose(T, rig.T_camera_lidar[name], atol=1e-9)


def test_other_formats_refuse_the_lidars_mounting(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="autoware only"):
        export_calibration(varied_rig(), tmp_path / "a.urdf", "urdf", T_base_lidar=LIDAR_POSE)


def test_names_of_frames_can_be_chosen(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    export_calibration(
        make_pair(), path, "tf2", lidar_frame="velodyne", camera_frame="cam/{camera}/optical"
    )
    transforms = yaml.safe_load(path.read_text())["transforms"]
    assert [t["child_frame_id"] for t in transforms] == ["cam/left/optical", "cam/right/optical"]
    assert {t["header"]["frame_id"] for t in transforms} == {"velodyne"}
    with pytest.raises(ValueError, match="two are the same"):
        export_calibration(make_pair(), path, "tf2", camera_frame="camera")
    with pytest.raises(ValueError, match="one is empty"):
        export_calibration(make_pair(), path, "tf2", lidar_frame="")


def test_strange_names_stay_one_word_and_well_formed(tmp_path: Path) -> None:
    camera = make_pair().cameras["left"]
    rig = Rig(lidar="top\nlidar", cameras={'a "b" --> <c> $(id)': camera})
    frame = "a__b__--___c____id__optical_frame"
    for format in ("ros1", "ros2", "ros2-launch", "urdf", "tf2", "autoware", "opencv", "json"):
        export_calibration(rig, tmp_path / format, format)
    for format in ("ros1", "ros2"):
        line = (tmp_path / format).read_text().splitlines()[-2]
        assert {"top_lidar", frame} <= set(shlex.split(line))
    (joint,) = URDF.from_xml_string((tmp_path / "urdf").read_text()).joints
    assert (joint.parent, joint.child) == ("top_lidar", frame)
    (node,) = ElementTree.parse(tmp_path / "ros2-launch").getroot()
    assert (node.get("args") or "").split()[-3:] == ["top_lidar", "--child-frame-id", frame]
    assert (
        yaml.safe_load((tmp_path / "tf2").read_text())["transforms"][0]["child_frame_id"] == frame
    )
    assert len(yaml.safe_load((tmp_path / "autoware").read_text())["sensor_kit_base_link"]) == 2
    assert list(READERS["opencv"](tmp_path / "opencv")) == list(rig.cameras)
    assert list(READERS["json"](tmp_path / "json")) == list(rig.cameras)


def test_lenses_are_exported_under_the_names_of_others(mixed_rig: Rig, tmp_path: Path) -> None:
    front, wide, side = mixed_rig.cameras.values()
    four = front.model_copy(update={"distortion": (*front.distortion[:4], 0.0)})
    rig = Rig(cameras={"front": four, "side": side})
    export_calibration(rig, tmp_path / "chain.yaml", "kalibr")
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    assert chain["cam0"]["distortion_model"] == "radtan"
    assert chain["cam0"]["distortion_coeffs"] == list(front.distortion[:4])
    assert chain["cam0"]["intrinsics"] == [718.0, 710.0, 607.0, 185.0]
    assert chain["cam1"]["distortion_model"] == "equidistant"
    assert chain["cam1"]["distortion_coeffs"] == list(side.distortion)
    export_calibration(mixed_rig, tmp_path / "rig.yml", "opencv")
    file = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    for index, camera in enumerate((front, wide, side)):
        node = file.getNode(f"camera_{index}")
        np.testing.assert_array_equal(node.getNode("camera_matrix").mat(), camera.matrix_px)
        coefficients = node.getNode("distortion_coefficients").mat().ravel()
        np.testing.assert_array_equal(coefficients, camera.distortion)
        assert node.getNode("fisheye_model").real() == (camera.model == "fisheye")


@pytest.mark.parametrize(
    ("format", "camera", "said"),
    [
        ("kalibr", "front", "Kalibr's radtan holds 4 distortion coefficients"),
        ("kitti", "side", "cannot hold a fisheye lens"),
        ("kitti", "wide", "holds no distortion coefficients"),
    ],
)
def test_a_lens_that_a_format_cannot_hold_is_refused(
    format: str, camera: str, said: str, mixed_rig: Rig, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=re.escape(said)) as caught:
        export_calibration(mixed_rig, tmp_path / "file", format, cameras=[camera])
    assert caught.value.camera == camera
    assert not list(tmp_path.iterdir())


def test_extrinsics_that_a_format_cannot_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="one rotation for all cameras"):
        export_calibration(varied_rig(), tmp_path / "a", "kitti", cameras=["front", "side"])
    with pytest.raises(CalibrationError, match="4 cameras, these are 5"):
        export_calibration(varied_rig(), tmp_path / "a", "kitti")
    assert not list(tmp_path.iterdir())


def test_a_failed_result_is_exported_on_request_only(failed: Calibration, tmp_path: Path) -> None:
    assert failed.verdict.status == "FAIL"
    path = tmp_path / "chain.yaml"
    with pytest.raises(CalibrationError, match="--even-if-failed"):
        export_calibration(failed, path, "kalibr")
    assert not path.exists()
    export_calibration(failed, path, "kalibr", even_if_failed=True)
    assert "verdict FAIL" in path.read_text()
    assert "covariance" not in yaml.safe_load(path.read_text())["cam0"]["calibgraph"]


def test_the_verdict_is_that_of_the_cameras_that_are_written(
    solved: Calibration, failed: Calibration, tmp_path: Path
) -> None:
    verdicts = {**solved.camera_verdicts, "right": failed.camera_verdicts["right"]}
    mixed = replace(solved, camera_verdicts=verdicts)
    with pytest.raises(
        CalibrationError, match="verdict of right is FAIL, nothing was written.*--camera left"
    ):
        export_calibration(mixed, tmp_path / "a.json", "json")
    export_calibration(mixed, tmp_path / "a.json", "json", cameras=["left"])
    assert json.loads((tmp_path / "a.json").read_text())["verdict"] != "FAIL"
    export_calibration(mixed, tmp_path / "a.json", "json", even_if_failed=True, force=True)
    cameras = json.loads((tmp_path / "a.json").read_text())["cameras"]
    assert cameras["left"]["covariance"] is not None
    assert cameras["right"]["covariance"] is None


def test_a_result_is_exported_from_its_folder(solved: Calibration, tmp_path: Path) -> None:
    solved.save(tmp_path / "result")
    export_calibration(tmp_path / "result", tmp_path / "a.json", "json")
    content = json.loads((tmp_path / "a.json").read_text())
    assert content["verdict"] == solved.verdict.status
    for name, T in solved.T_camera_lidar.items():
        np.testing.assert_allclose(content["cameras"][name]["T_camera_lidar"], T, atol=1e-15)


def test_files_hold_the_covariance_in_the_order_of_ros(solved: Calibration, tmp_path: Path) -> None:
    for format in ("kalibr", "opencv", "json"):
        export_calibration(solved, tmp_path / f"a.{format}", format)
    chain = yaml.safe_load((tmp_path / "a.kalibr").read_text())
    cameras = json.loads((tmp_path / "a.json").read_text())["cameras"]
    file = cv2.FileStorage(str(tmp_path / "a.opencv"), cv2.FILE_STORAGE_READ)
    for index, (name, covariance) in enumerate(solved.covariance.items()):
        assert covariance is not None
        # The camera's centre moves by -R v, and its axes turn by -R w, in the LiDAR's axes.
        R = solved.T_camera_lidar[name][:3, :3].T
        turn = np.block([[R, np.zeros((3, 3))], [np.zeros((3, 3)), R]])
        expected = turn @ np.roll(covariance, (3, 3), (0, 1)) @ turn.T
        for found in (
            chain[f"cam{index}"]["calibgraph"]["covariance"],
            cameras[name]["covariance"],
            file.getNode(f"camera_{index}").getNode("covariance").mat(),
        ):
            np.testing.assert_allclose(np.reshape(found, (6, 6)), expected, rtol=1e-9)


def test_files_that_are_there_are_replaced_only_with_force(tmp_path: Path) -> None:
    rig, path = make_pair(), tmp_path / "mine.yaml"
    rig.save(path)
    before = path.read_text()
    with pytest.raises(FileError, match="is there already"):
        export_calibration(path, path, "kalibr")
    assert path.read_text() == before
    export_calibration(path, path, "kalibr", force=True)
    assert path.read_text() != before
    export_calibration(rig, tmp_path / "calib.txt", "kitti")
    (tmp_path / "calib.txt").unlink()
    with pytest.raises(FileError, match="calib.direction.txt: is there already"):
        export_calibration(rig, tmp_path / "calib.txt", "kitti")


def test_unknown_formats_and_cameras_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="format 'ros': known are kalibr, ros1"):
        export_calibration(make_pair(), tmp_path / "a", "ros")
    with pytest.raises(ValueError, match="camera 'rear': the rig has left, right"):
        export_calibration(make_pair(), tmp_path / "a", "json", cameras=["rear"])


def test_kitti_sequences_read_what_was_exported(tmp_path: Path) -> None:
    rig = rig_for("kitti")
    export_calibration(rig, tmp_path / "calib.txt", "kitti")
    for name in rig.cameras:
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "000000.png"), np.zeros((376, 1240), np.uint8))
    again = load_rig(tmp_path)
    for name, T in rig.T_camera_lidar.items():
        np.testing.assert_allclose(again.T_camera_lidar[name], T, atol=1e-12)
