"""Lenses that see all round, in the files of other programs: by the formulas of these."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from calibgraph import CalibrationError, Camera, Rig, export_calibration, import_rig
from calibgraph.simulation.rigs import rig_of

POINT = np.array([2.0, -0.7, -0.4])  # behind the lens


@pytest.fixture
def omni() -> Camera:
    return rig_of("omni").cameras["front"]


def unified_pixel(xi: float, focal: list[float], coefficients: list[float]) -> list[float]:
    """cv2.omnidir.projectPoints, and Kalibr's omni-radtan, of a point in the camera frame."""
    x, y, z = POINT / np.linalg.norm(POINT)
    u, v = x / (z + xi), y / (z + xi)
    k1, k2, p1, p2 = coefficients
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2 * r2
    fx, fy, cx, cy = focal
    return [
        fx * (u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) + cx,
        fy * (v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v) + cy,
    ]


@pytest.mark.parametrize("format", ["kalibr", "opencv", "json"])
def test_a_unified_lens_projects_in_other_formats_as_here(
    format: str, omni: Camera, tmp_path: Path
) -> None:
    path = tmp_path / "file.yml"
    export_calibration(Rig(cameras={"front": omni}), path, format)
    if format == "kalibr":
        camera = yaml.safe_load(path.read_text())["cam0"]
        assert (camera["camera_model"], camera["distortion_model"]) == ("omni", "radtan")
        (xi, *focal), coefficients = camera["intrinsics"], camera["distortion_coeffs"]
    elif format == "opencv":
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        node = file.getNode("camera_0")
        K = node.getNode("camera_matrix").mat()
        focal, xi = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], node.getNode("xi").real()
        coefficients = node.getNode("distortion_coefficients").mat().ravel().tolist()
    else:
        camera = json.loads(path.read_text())["cameras"]["front"]
        assert camera["model"] == "omnidirectional"
        focal = [camera["intrinsics_px"][key] for key in ("fx", "fy", "cx", "cy")]
        xi, *coefficients = camera["distortion"]
    pixels, valid = omni.lens.project(POINT)
    np.testing.assert_allclose(unified_pixel(xi, focal, coefficients), pixels[0], atol=1e-9)
    assert valid.all()


@pytest.mark.parametrize("format", ["kalibr", "opencv"])
def test_a_unified_lens_is_imported_as_it_was_exported(
    format: str, omni: Camera, tmp_path: Path
) -> None:
    path = tmp_path / "file.yaml"
    export_calibration(Rig(cameras={"front": omni}), path, format)
    again = import_rig([path], size_px=(1280, 1280)).cameras["front"]
    np.testing.assert_allclose(again.T_camera_lidar, omni.T_camera_lidar, atol=1e-9)
    theirs, ours = (c.model_dump(exclude={"T_camera_lidar"}) for c in (again, omni))
    assert theirs == ours


def test_a_panorama_is_written_where_there_is_room_for_it(tmp_path: Path) -> None:
    rig = rig_of("panorama")
    for format in ("opencv", "json", "urdf"):
        export_calibration(rig, tmp_path / f"{format}.yml", format)
    again = import_rig([tmp_path / "opencv.yml"]).cameras["panorama"]
    pixels, _ = rig.cameras["panorama"].lens.project(POINT)
    np.testing.assert_allclose(again.lens.project(POINT)[0], pixels, atol=1e-9)
    for format in ("kalibr", "kitti"):
        with pytest.raises(CalibrationError, match="cannot hold a.* equirectangular"):
            export_calibration(rig, tmp_path / format, format)


@pytest.mark.parametrize(
    ("model", "distortion", "found"),
    [
        ("mei", [1.2, -0.1, 0.02, 0, 0], "omnidirectional"),
        ("omnidir", [1.2, -0.1, 0.02, 0, 0], "omnidirectional"),
        ("equirectangular", [], "equirectangular"),
    ],
)
def test_camera_info_names_wide_lenses(
    model: str, distortion: list[float], found: str, tmp_path: Path
) -> None:
    """ROS has no place for xi: it is the first of D."""
    info = {
        "image_width": 1280,
        "image_height": 960,
        "camera_matrix": {"data": [400.0, 0, 640, 0, 400, 480, 0, 0, 1]},
        "distortion_model": model,
        "distortion_coefficients": {"data": distortion},
    }
    (tmp_path / "front.yaml").write_text(yaml.safe_dump(info))
    export_calibration(rig_of("kitti"), tmp_path / "tree.yaml", "tf2")
    rig = import_rig(
        [tmp_path / "front.yaml", tmp_path / "tree.yaml"],
        camera_frames={"front": "image_2_optical_frame"},
    )
    assert rig.cameras["front"].model == found
    assert list(rig.cameras["front"].distortion) == distortion


def test_an_omni_lens_with_another_distortion_is_refused(omni: Camera, tmp_path: Path) -> None:
    export_calibration(Rig(cameras={"front": omni}), tmp_path / "chain.yaml", "kalibr")
    text = (tmp_path / "chain.yaml").read_text()
    for old, new, said in (
        ("distortion_model: radtan", "distortion_model: fov", "lens model 'fov' is none of"),
        ("distortion_model: radtan", "distortion_model: equi", "contradict each other"),
        ("intrinsics: [1.3,", "intrinsics: [-1.3,", "xi of the unified model is -1.3"),
    ):
        assert old in text
        (tmp_path / "wrong.yaml").write_text(text.replace(old, new))
        with pytest.raises(CalibrationError, match=said):
            import_rig([tmp_path / "wrong.yaml"])
