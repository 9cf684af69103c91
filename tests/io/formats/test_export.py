"""Every exported file, read by an independent reader; lenses by the formulas of others."""

import json
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
    import_rig,
    load_rig,
)
from calibgraph.io.formats import EXPORT_FORMATS
from calibgraph.io.formats.export import TRANSFORMS, WRITERS
from calibgraph.simulation.rigs import rig_of
from tests.conftest import make_pair, require_poses
from tests.io.formats.conftest import varied_rig
from tests.io.formats.readers import READERS, angles_pose, worked_points

LIDAR_POSE = angles_pose([1.2, -0.1, 1.9], 0.02, -0.03, 1.4)


def test_each_format_has_a_meaning_a_writer_and_an_independent_reader() -> None:
    assert set(EXPORT_FORMATS) == set(WRITERS) == {*READERS, "camera_info"}  # has no extrinsics


@pytest.mark.parametrize("format", READERS)
def test_an_independent_reader_finds_the_extrinsics_that_the_worked_point_proves(
    format: str, tmp_path: Path
) -> None:
    rig, path = varied_rig(), tmp_path / "file.txt"
    export_calibration(rig, path, format)
    found, points = READERS[format](path), worked_points(path.read_text())
    assert set(found) == set(points) == set(rig.cameras)
    for name, T in rig.T_camera_lidar.items():
        np.testing.assert_allclose(found[name], T, atol=1e-9, rtol=0)
        p_lidar, p_camera = points[name]
        # Six digits are printed: half a unit of the last is the largest error.
        np.testing.assert_allclose((found[name] @ [*p_lidar, 1])[:3], p_camera, atol=5.1e-7)
        assert np.abs((np.linalg.inv(found[name]) @ [*p_lidar, 1])[:3] - p_camera).max() > 0.1


def test_the_lidars_mounting_moves_sensors_together(tmp_path: Path) -> None:
    rig = varied_rig()
    export_calibration(rig, tmp_path / "file.txt", "autoware", T_base_lidar=LIDAR_POSE)
    text = (tmp_path / "file.txt").read_text()
    assert "--lidar-pose puts it" in text
    pose = yaml.safe_load(text)["sensor_kit_base_link"]["lidar"]
    assert [pose[key] for key in ("x", "y", "z", "yaw")] == pytest.approx([1.2, -0.1, 1.9, 1.4])
    require_poses(READERS["autoware"](tmp_path / "file.txt"), rig.T_camera_lidar, atol=1e-9)


def test_names_of_frames_can_be_chosen(tmp_path: Path) -> None:
    path = tmp_path / "a.urdf"
    export_calibration(
        make_pair(), path, "urdf", lidar_frame="velodyne", camera_frame="cam/{camera}/optical"
    )
    joints = URDF.from_xml_string(path.read_text()).joints
    assert [joint.child for joint in joints] == ["cam/left/optical", "cam/right/optical"]
    assert {joint.parent for joint in joints} == {"velodyne"}
    with pytest.raises(ValueError, match="two are the same"):
        export_calibration(make_pair(), path, "urdf", camera_frame="camera")
    with pytest.raises(ValueError, match="one is empty"):
        export_calibration(make_pair(), path, "urdf", lidar_frame="")


def test_strange_names_stay_one_word_and_well_formed(tmp_path: Path) -> None:
    camera = make_pair().cameras["left"]
    rig = Rig(lidar="top\nlidar", cameras={'a "b" --> <c> $(id)': camera})
    frame = "a__b__--___c____id__optical_frame"
    for format in ("ros2-launch", "urdf", "autoware", "opencv", "json"):
        export_calibration(rig, tmp_path / format, format)
    (joint,) = URDF.from_xml_string((tmp_path / "urdf").read_text()).joints
    assert (joint.parent, joint.child) == ("top_lidar", frame)
    (node,) = ElementTree.parse(tmp_path / "ros2-launch").getroot()
    assert (node.get("args") or "").split()[-3:] == ["top_lidar", "--child-frame-id", frame]
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
    omni = rig_of("omni")
    (xi, *coefficients), lens = omni.cameras["front"].distortion, omni.cameras["front"]
    export_calibration(omni, tmp_path / "omni.yaml", "kalibr")
    found = yaml.safe_load((tmp_path / "omni.yaml").read_text())["cam0"]
    assert (found["camera_model"], found["distortion_model"]) == ("omni", "radtan")
    assert found["intrinsics"] == [xi, *lens.intrinsics_px.model_dump().values()]
    assert found["distortion_coeffs"] == coefficients
    export_calibration(omni, tmp_path / "omni.yml", "opencv")
    file = cv2.FileStorage(str(tmp_path / "omni.yml"), cv2.FILE_STORAGE_READ)
    node = file.getNode("camera_0")
    assert node.getNode("xi").real() == xi
    assert node.getNode("distortion_coefficients").mat().ravel().tolist() == coefficients


def test_a_lens_that_a_format_cannot_hold_is_refused(mixed_rig: Rig, tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="radtan holds 4 distortion coefficients") as caught:
        export_calibration(mixed_rig, tmp_path / "file", "kalibr", cameras=["front"])
    assert caught.value.camera == "front"
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
    (tmp_path / "right.yaml").write_text("mine")
    with pytest.raises(FileError, match="right.yaml: is there already"):
        export_calibration(rig, tmp_path, "camera_info")
    assert not (tmp_path / "left.yaml").exists()
    assert len(export_calibration(rig, tmp_path, "camera_info", force=True)) == 2


_KEYS = [
    "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model",
    "distortion_coefficients", "rectification_matrix", "projection_matrix",
]  # fmt: skip
"""camera_calibration_parsers/parse_yml.cpp: all of them are required."""


HELD = {
    "kalibr": ("varied", "kitti", "fisheye", "omni"), "ros2-launch": ("varied",),
    "urdf": ("kitti", "walkley", "fisheye", "omni", "mixed"), "autoware": ("varied",),
    "opencv": ("varied", "mixed", "omni"), "json": ("varied", "mixed"),
}  # fmt: skip
SUFFIXES = {"urdf": ".urdf", "ros2-launch": ".launch.xml", "json": ".json"}


@pytest.mark.parametrize(
    ("format", "name"), [(format, name) for format, names in HELD.items() for name in names]
)
def test_what_was_exported_is_imported_again(
    format: str, name: str, mixed_rig: Rig, tmp_path: Path
) -> None:
    """Of formats that hold frames alone, with the lenses of a camera_info."""
    own = {"varied": varied_rig(), "mixed": mixed_rig}
    rig = own[name] if name in own else rig_of(name)
    files = export_calibration(rig, tmp_path / f"file{SUFFIXES.get(format, '.yaml')}", format)
    infos = export_calibration(rig, tmp_path, "camera_info") if format in TRANSFORMS else ()
    again = import_rig([*files, *infos])
    assert list(again.cameras) == list(rig.cameras)
    assert not again.relative_poses  # what was computed from T_camera_lidar is no measurement
    point = np.array([0.4, -0.3, 2.0])
    for camera, before in rig.cameras.items():
        found = again.cameras[camera]
        np.testing.assert_allclose(found.T_camera_lidar, before.T_camera_lidar, atol=1e-9, rtol=0)
        np.testing.assert_array_equal(found.lens.project(point)[0], before.lens.project(point)[0])
        for key in ("model", "intrinsics_px", "width_px", "height_px"):
            assert getattr(found, key) == getattr(before, key)
    if format == "json":
        assert load_rig(files[0]).model_dump_json() == again.model_dump_json()
    if (format, name) == ("urdf", "mixed"):
        lens = yaml.safe_load((tmp_path / "wide.yaml").read_text())
        assert lens["distortion_model"] == "rational_polynomial"


def test_a_file_has_what_the_parser_of_ros_requires(tmp_path: Path) -> None:
    rig = make_pair()
    files = export_calibration(rig, tmp_path / "infos", "camera_info", cameras=["left"])
    assert [file.name for file in files] == ["left.yaml"]
    text = files[0].read_text()
    found, K = yaml.safe_load(text), rig.cameras["left"].matrix_px
    assert list(found) == _KEYS
    for key, matrix in (
        ("camera_matrix", K),
        ("rectification_matrix", np.eye(3)),
        ("projection_matrix", np.column_stack([K, np.zeros(3)])),
    ):
        assert (found[key]["rows"], found[key]["cols"]) == matrix.shape
        assert found[key]["data"] == matrix.ravel().tolist()
    assert found["distortion_coefficients"] == {"rows": 1, "cols": 5, "data": [0.0] * 5}
    assert "export it as ros2-launch" in text


def test_what_has_no_place_in_files_of_ros_is_refused(tmp_path: Path) -> None:
    camera = make_pair().cameras["left"]
    other = camera.model_copy(update={"frame_id": "other"})
    for names in (("a b", "a_b"), ("A_b", "a_b")):  # one file where systems ignore case
        alike = Rig(cameras=dict(zip(names, (other, camera), strict=True)))
        with pytest.raises(CalibrationError, match="another has the file a_b.yaml"):
            export_calibration(alike, tmp_path / "infos", "camera_info")
    assert not (tmp_path / "infos").exists()


def test_the_name_in_a_file_is_the_files(tmp_path: Path) -> None:
    rig = Rig(cameras={"front left": make_pair().cameras["left"]})
    (file,) = export_calibration(rig, tmp_path, "camera_info")
    assert yaml.safe_load(file.read_text())["camera_name"] == file.stem == "front_left"
