"""A lens model is understood under any key and name; an open one is asked, none is dropped."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from calibgraph import Camera, import_rig
from calibgraph.errors import CalibrationError
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


FOCAL = {"fx": 320.0, "fy": 320.0, "cx": 640.0, "cy": 400.0, "width": 1280, "height": 800}
NAMED = {**FOCAL, "T_C_L": FRONT.tolist(), "k1": 0.1, "k2": 0.0}
FIVE, ZEROS, NOTE = [*FOUR, 0.1], [0.0] * 5, "four numbers and no key names the lens model"
UNDERSTOOD: list[tuple[dict[str, Any], list[float], str]] = [
    *((lens(matrix(4, 1, FOUR), distortion_model=name), FOUR, "") for name in PINHOLES),
    *((lens(four), FOUR, NOTE) for four in (matrix(1, 4, FOUR), FOUR, [FOUR])),
    *((lens(four, model="plumb_bob"), FOUR, "") for four in (matrix(1, 4, FOUR), FOUR, [FOUR])),
    (lens(matrix(1, 5, FIVE)), FIVE, ""),
    (lens(matrix(5, 1, FIVE)), FIVE, ""),
    (lens(matrix(4, 1, [0] * 4)), [], ""),
    ({**NAMED, "p1": 0.1, "p2": 0.0}, [0.1, 0.0, 0.1, 0.0], ""),
]


@pytest.mark.parametrize(
    ("content", "coefficients", "note"), UNDERSTOOD, ids=range(len(UNDERSTOOD))
)
def test_a_pinhole_is_understood_with_a_note_if_it_may_be_a_fisheye(
    content: dict[str, Any], coefficients: list[float], note: str, tmp_path: Path
) -> None:
    path = as_opencv_yaml(tmp_path, content)
    camera = camera_of(path)
    assert (camera.model, list(camera.distortion)) == ("pinhole", coefficients)
    notes = read_rig_parts([path]).notes
    assert len(notes) == bool(note) and all(note in each for each in notes)


LIST, COLUMN = "add the line `distortion_model: fisheye` or", "is a column of four, as of OpenCV's"
KNOWN = "is none of calibgraph's, which are pinhole (plumb_bob"
CONTRADICT = "contradict each other; keep the one that is right"
REFUSED: list[tuple[dict[str, Any], str]] = [
    *((lens(matrix(4, 1, FOUR), model_type=name), f"lens model '{name}' {KNOWN}")
      for name in ("ds", "eucm", "thin_prism", "fov", "7")),
    # as cv2.fisheye.calibrate returns them: a pinhole's are a row, or five
    (lens(matrix(4, 1, FOUR)), LIST),
    (lens([[value] for value in FOUR]), COLUMN),
    (lens(matrix(4, 1, FOUR), model=""), COLUMN),
    ({**NAMED, "k3": 0.1, "k4": 0.0}, "may be of a fisheye"),
    *((lens(matrix(4, 1, FOUR), **keys), CONTRADICT) for keys in (
        {"model": "fisheye", "distortion_model": "plumb_bob"},
        {"camera_model": "plumb_bob", "DistModel": "equidistant"},
        {"model_type": "KANNALA_BRANDT", "model": "pinhole"},
        {"model": "omni", "distortion_model": "equidistant"},
        {"distortion_model": "radtan", "fisheye_model": 1},
    )),
    (lens(ZEROS, K=[1, 0, 0, 0, 1, 0, 0, 0, 1]), "camera_matrix and K differ"),
    (lens(ZEROS, **{"Camera1.fx": 3, "Camera2.fx": 4}), "Camera1.fx and Camera2.fx differ"),
    (lens(ZEROS, xi=1.2, model="pinhole"), "xi is of an omnidirectional lens"),
    (lens(FOUR, model="omnidir"), "key 'xi' is missing"),
    (lens(ZEROS, T_lidar_camera=matrix(4, 4, np.eye(4).ravel().tolist())),
     "different T_camera_lidar"),
    *((lens(ZEROS, matrix_px=[float(v) for v in K]), said) for K, said in (
        ([480, 9, 320, 0, 480, 180, 0, 0, 1], "camera_matrix: begins with"),
        ([480, 0, 0, 0, 480, 0, 320, 180, 1], "it looks transposed"),
        ([480, -0.2, 320, 0, 480, 180, 0, 0, 1], "its skew is -0.2 px"),
        ([0, 480, 320, 480, 0, 180, 0, 0, 1], "holds no focal length"),
        ([-480, 0, 320, 0, 480, 180, 0, 0, 1], "holds no focal length"),
    )),
]  # fmt: skip


@pytest.mark.parametrize("write", LANGUAGES)
@pytest.mark.parametrize(("content", "said"), REFUSED, ids=range(len(REFUSED)))
def test_an_open_or_contradictory_lens_is_refused_in_one_line(
    content: dict[str, Any], said: str, write: Writer, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError) as caught:
        import_rig([write(tmp_path, content)])
    assert said in str(caught.value) and "\n" not in str(caught.value)


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


def test_a_skew_that_moves_no_point_by_a_tenth_of_a_pixel_is_rounded() -> None:
    found = intrinsics_of_matrix([[480, 0.04, 320], [0, 481, 180], [0, 0, 1]], "K")
    assert tuple(found.model_dump().values()) == (480, 481, 320, 180)
