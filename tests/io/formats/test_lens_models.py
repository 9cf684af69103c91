"""A lens model is understood under any key and name; an open one is asked, none is dropped."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import Camera, import_rig
from calibgraph.errors import CalibrationError, FileError
from calibgraph.io.formats.rig_import import read_rig_parts
from calibgraph.io.lenses import intrinsics_of_matrix, stated_model
from tests.io.formats.calibration_files import FRONT

K = [320.0, 0.0, 640.0, 0.0, 320.0, 400.0, 0.0, 0.0, 1.0]
FOUR = [0.08, -0.02, 0.004, -0.001]
Writer = Callable[[Path, dict[str, Any]], Path]


def matrix(rows: int, cols: int, data: list[float]) -> dict[str, Any]:
    return {"rows": rows, "cols": cols, "data": data}


def lens(coefficients: Any, matrix_px: list[float] | None = None, **keys: Any) -> dict[str, Any]:
    return {
        "image_width": 1280,
        "image_height": 800,
        "camera_matrix": matrix(3, 3, matrix_px or K),
        "distortion_coefficients": coefficients,
        "T_camera_lidar": matrix(4, 4, FRONT.ravel().tolist()),
        **keys,
    }


def as_yaml(folder: Path, content: dict[str, Any], first: str = "") -> Path:
    (folder / "a.yaml").write_text(first + yaml.safe_dump(content))
    return folder / "a.yaml"


def as_opencv_yaml(folder: Path, content: dict[str, Any]) -> Path:
    return as_yaml(folder, content, "%YAML:1.0\n---\n")


def as_json(folder: Path, content: dict[str, Any]) -> Path:
    (folder / "a.json").write_text(json.dumps({"cameras": {"a": content}}))
    return folder / "a.json"


LANGUAGES = [as_yaml, as_opencv_yaml, as_json]
KEYS = ("model", "camera_model", "distortion_model", "DistModel", "dist_model", "cam_model",
        "projection_model", "model_type", "cameraModel", "type", "Camera.type", "camera_type",
        "lens_model")  # fmt: skip
FISHEYES = ("fisheye", "Fisheye", "equidistant", "equi", "KANNALA_BRANDT", "kannala-brandt",
            "KannalaBrandt8", "opencv_fisheye", "Kannala Brandt", "pinhole-equi")  # fmt: skip
PINHOLES = ("pinhole", "radtan", "plumb_bob", "Plumb Bob", "rational_polynomial", "PINHOLE",
            "radial-tangential", "brown_conrady")  # fmt: skip


def camera_of(path: Path) -> Camera:
    (camera,) = import_rig([path]).cameras.values()
    return camera


@pytest.mark.parametrize("write", LANGUAGES)
@pytest.mark.parametrize("index", range(len(KEYS)))
def test_a_model_is_understood_under_any_key(index: int, write: Writer, tmp_path: Path) -> None:
    name = FISHEYES[index % len(FISHEYES)]
    content = lens(matrix(4, 1, FOUR), **{KEYS[index]: name})
    camera = camera_of(write(tmp_path, content))
    assert (camera.model, list(camera.distortion)) == ("fisheye", FOUR)


@pytest.mark.parametrize("name", FISHEYES)
def test_names_of_fisheyes_are_understood_in_a_camchain(name: str, tmp_path: Path) -> None:
    camera = {"camera_model": "pinhole", "distortion_model": name, "resolution": [1280, 800],
              "intrinsics": [320, 320, 640, 400], "distortion_coeffs": FOUR,
              "T_cam_lidar": FRONT.tolist()}  # fmt: skip
    assert camera_of(as_yaml(tmp_path, {"cam0": camera})).model == "fisheye"


@pytest.mark.parametrize("name", PINHOLES)
def test_names_of_pinholes_leave_four_in_a_column_to_a_pinhole(name: str, tmp_path: Path) -> None:
    camera = camera_of(as_opencv_yaml(tmp_path, lens(matrix(4, 1, FOUR), distortion_model=name)))
    assert (camera.model, list(camera.distortion)) == ("pinhole", FOUR)


@pytest.mark.parametrize("write", LANGUAGES)
@pytest.mark.parametrize("name", ["ds", "eucm", "thin_prism", "fov", "7"])
def test_an_unknown_model_is_one_line_that_lists_the_known_ones(
    name: str, write: Writer, tmp_path: Path
) -> None:
    path = write(tmp_path, lens(matrix(4, 1, FOUR), model_type=name))
    with pytest.raises(CalibrationError) as caught:
        import_rig([path])
    message = str(caught.value)
    assert f"lens model '{name}' is none of calibgraph's, which are pinhole (plumb_bob" in message
    assert "fisheye (equidistant" in message and "\n" not in message


@pytest.mark.parametrize("write", LANGUAGES)
def test_four_in_a_column_and_no_model_are_a_question(write: Writer, tmp_path: Path) -> None:
    """As cv2.fisheye.calibrate returns them: a pinhole's are a row, or five."""
    path = write(tmp_path, lens(matrix(4, 1, FOUR)))
    with pytest.raises(CalibrationError, match="add the line `distortion_model: fisheye` or"):
        import_rig([path])
    for content in (lens([[value] for value in FOUR]), lens(matrix(4, 1, FOUR), model="")):
        with pytest.raises(CalibrationError, match="is a column of four, as of OpenCV's fisheye"):
            import_rig([as_json(tmp_path, content)])


@pytest.mark.parametrize("coefficients", [matrix(1, 4, FOUR), FOUR, [FOUR]])
def test_four_in_a_row_and_no_model_are_a_pinhole_with_a_note(
    coefficients: Any, tmp_path: Path
) -> None:
    path = as_yaml(tmp_path, lens(coefficients))
    assert camera_of(path).model == "pinhole"
    (note,) = read_rig_parts([path]).notes
    assert "four numbers and no key names the lens model" in note
    assert read_rig_parts([as_yaml(tmp_path, lens(coefficients, model="plumb_bob"))]).notes == ()


@pytest.mark.parametrize(
    "coefficients", [matrix(1, 5, [*FOUR, 0.1]), matrix(5, 1, [*FOUR, 0.1]), matrix(4, 1, [0] * 4)]
)
def test_five_coefficients_or_zeros_are_no_question(coefficients: Any, tmp_path: Path) -> None:
    path = as_yaml(tmp_path, lens(coefficients))
    assert camera_of(path).model == "pinhole"
    assert read_rig_parts([path]).notes == ()


@pytest.mark.parametrize(
    "keys",
    [
        {"model": "fisheye", "distortion_model": "plumb_bob"},
        {"camera_model": "plumb_bob", "DistModel": "equidistant"},
        {"model_type": "KANNALA_BRANDT", "model": "pinhole"},
        {"model": "omni", "distortion_model": "equidistant"},
        {"distortion_model": "radtan", "fisheye_model": 1},
    ],
)
def test_keys_that_contradict_each_other_are_refused(keys: dict[str, Any], tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="contradict each other; keep the one that is right"):
        import_rig([as_yaml(tmp_path, lens(matrix(4, 1, FOUR), **keys))])


@pytest.mark.parametrize(
    ("keys", "model"),
    [
        ({"camera_model": "pinhole", "distortion_model": "equidistant"}, "fisheye"),
        ({"camera_model": "omni", "distortion_model": "radtan"}, "omnidirectional"),
        ({"camera_model": "fisheye", "distortion_model": "none"}, "fisheye"),
        ({"model": "Pinhole", "fisheye_model": 1}, "fisheye"),
        ({"distortion_type": 1}, "fisheye"),
        ({"distortion_type": 0}, "pinhole"),
        ({"is_fisheye": True}, "fisheye"),
        ({"name": "fisheye"}, None),
        ({}, None),
    ],
)
def test_two_keys_state_one_model(keys: dict[str, Any], model: str | None) -> None:
    assert stated_model(keys, "a") == model


@pytest.mark.parametrize("write", LANGUAGES)
@pytest.mark.parametrize(
    ("matrix_px", "said"),
    [
        ([480, 9, 320, 0, 480, 180, 0, 0, 1], "its skew is 9 px"),
        ([960, 0, 640, 0, 960, 360, 0, 0, 2], "undo its scale: divide by 2"),
        ([480, 0, 0, 0, 480, 0, 320, 180, 1], "it looks transposed"),
        ([0] * 9, "holds no focal length"),
    ],
)
def test_a_matrix_of_another_form_is_refused_in_all_languages(
    matrix_px: list[float], said: str, write: Writer, tmp_path: Path
) -> None:
    path = write(tmp_path, lens(matrix(1, 5, [0.0] * 5), matrix_px=[float(v) for v in matrix_px]))
    with pytest.raises(CalibrationError, match=said) as caught:
        import_rig([path])
    assert "camera_matrix" in str(caught.value)


def test_keys_that_differ_are_refused(tmp_path: Path) -> None:
    for keys, said in (
        ({"K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}, "camera_matrix and K differ"),
        ({"Camera1.fx": 3, "Camera2.fx": 4}, "Camera1.fx and Camera2.fx differ"),
        ({"xi": 1.2, "model": "pinhole"}, "xi is of an omnidirectional lens"),
        ({"model": "omnidir", "distortion_coefficients": FOUR}, "key 'xi' is missing"),
        ({"T_lidar_camera": matrix(4, 4, np.eye(4).ravel().tolist())}, "different T_camera_lidar"),
    ):
        with pytest.raises(CalibrationError, match=said):
            import_rig([as_yaml(tmp_path, {**lens(matrix(1, 5, [0.0] * 5)), **keys})])


def test_named_coefficients_without_a_model_are_a_question(tmp_path: Path) -> None:
    focal = {"fx": 320.0, "fy": 320.0, "cx": 640.0, "cy": 400.0, "width": 1280, "height": 800}
    named = {**focal, "T_C_L": FRONT.tolist()}
    path = as_yaml(tmp_path, {**named, "k1": 0.1, "k2": 0.0, "k3": 0.1, "k4": 0.0})
    with pytest.raises(CalibrationError, match="may be of a fisheye"):
        import_rig([path])
    path = as_yaml(tmp_path, {**named, "k1": 0.1, "k2": 0.0, "p1": 0.1, "p2": 0.0})
    assert camera_of(path).distortion == (0.1, 0.0, 0.1, 0.0)


@pytest.mark.parametrize(
    ("K", "said"),
    [
        ([[480, 9, 320], [0, 480, 180], [0, 0, 1]], "its skew is 9 px"),
        ([[480, -0.2, 320], [0, 480, 180], [0, 0, 1]], "its skew is -0.2 px"),
        ([[960, 0, 640], [0, 960, 360], [0, 0, 2]], "undo its scale: divide by 2"),
        ([[480, 0, 0], [0, 480, 0], [320, 180, 1]], "write its rows first"),
        ([[480, 0, 0], [0, 1, 0], [0, 7e-310, 2.5e-323]], "write the camera matrix"),
        ([[0, 480, 320], [480, 0, 180], [0, 0, 1]], "holds no focal length"),
        ([[0] * 3] * 3, "holds no focal length"),
        ([[-480, 0, 320], [0, 480, 180], [0, 0, 1]], "holds no focal length"),
        ([[480, 0, float("nan")], [0, 480, 180], [0, 0, 1]], "holds no focal length"),
        ([[480, 0, 320, 0], [0, 480, 180, 0], [0, 0, 1, 0]], "has the shape (3, 4)"),
    ],
)
def test_what_is_no_camera_matrix_is_refused(K: Any, said: str) -> None:
    with pytest.raises(FileError) as caught:
        intrinsics_of_matrix(K, "lens.yaml: K")
    assert said in str(caught.value)
    assert str(caught.value).startswith("lens.yaml: K")


def test_a_skew_that_moves_no_point_by_a_tenth_of_a_pixel_is_rounded() -> None:
    found = intrinsics_of_matrix([[480, 0.04, 320], [0, 481, 180], [0, 0, 1]], "K")
    assert tuple(found.model_dump().values()) == (480, 481, 320, 180)
