"""Exported camera_info: as ROS's parser wants it, and as the importer reads it again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from calibgraph import CalibrationError, FileError, Rig, export_calibration, import_rig
from calibgraph.simulation.rigs import rig_of
from tests.conftest import make_pair

_KEYS = [
    "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model",
    "distortion_coefficients", "rectification_matrix", "projection_matrix",
]  # fmt: skip
"""camera_calibration_parsers/parse_yml.cpp: all of them are required."""


def with_its_lens_again(rig: Rig, folder: Path) -> Rig:
    """Export lenses as camera_info and extrinsics as tf2, and import both."""
    infos = export_calibration(rig, folder / "infos", "camera_info")
    (tree,) = export_calibration(rig, folder / "tree.yaml", "tf2")
    return import_rig([*infos, tree])


@pytest.mark.parametrize("name", ["kitti", "walkley", "fisheye", "omni"])
def test_lenses_are_imported_as_they_were_exported(name: str, tmp_path: Path) -> None:
    rig = rig_of(name)
    again = with_its_lens_again(rig, tmp_path)
    assert list(again.cameras) == list(rig.cameras)
    for camera, own in rig.cameras.items():
        found = again.cameras[camera]
        point = np.array([0.4, -0.3, 2.0])
        np.testing.assert_array_equal(found.lens.project(point)[0], own.lens.project(point)[0])
        assert (found.model, found.intrinsics_px) == (own.model, own.intrinsics_px)
        assert (found.width_px, found.height_px) == (own.width_px, own.height_px)


def test_eight_coefficients_are_rational(mixed_rig: Rig, tmp_path: Path) -> None:
    again = with_its_lens_again(mixed_rig, tmp_path)
    found = yaml.safe_load((tmp_path / "infos" / "wide.yaml").read_text())
    assert found["distortion_model"] == "rational_polynomial"
    for name, camera in mixed_rig.cameras.items():
        assert again.cameras[name].distortion == camera.distortion


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
    assert "export it as tf2" in text


def test_lenses_that_are_there_stay(tmp_path: Path) -> None:
    rig = make_pair()
    (tmp_path / "right.yaml").write_text("mine")
    with pytest.raises(FileError, match="right.yaml: is there already"):
        export_calibration(rig, tmp_path, "camera_info")
    assert not (tmp_path / "left.yaml").exists()
    assert len(export_calibration(rig, tmp_path, "camera_info", force=True)) == 2


def test_what_has_no_place_in_files_of_ros_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot hold a lens of the model equirect"):
        export_calibration(rig_of("panorama"), tmp_path / "infos", "camera_info")
    camera = make_pair().cameras["left"]
    other = camera.model_copy(update={"frame_id": "other"})
    alike = Rig(cameras={"a b": other, "a_b": camera})
    with pytest.raises(CalibrationError, match="another has the file a_b.yaml"):
        export_calibration(alike, tmp_path / "infos", "camera_info")
    assert not (tmp_path / "infos").exists()


def test_names_that_differ_in_case_alone_are_refused(tmp_path: Path) -> None:
    """Where file systems ignore case, one would overwrite the other."""
    camera = make_pair().cameras["left"]
    alike = Rig(cameras={"Front": camera, "front": camera})
    with pytest.raises(CalibrationError, match="another has the file"):
        export_calibration(alike, tmp_path / "infos", "camera_info")


def test_the_name_in_a_file_is_the_files(tmp_path: Path) -> None:
    rig = Rig(cameras={"front left": make_pair().cameras["left"]})
    (file,) = export_calibration(rig, tmp_path, "camera_info")
    assert yaml.safe_load(file.read_text())["camera_name"] == file.stem == "front_left"
