"""Lenses and extrinsics for Kalibr, KITTI, ROS's camera_info, OpenCV, and as plain JSON."""

import json
import re
from collections.abc import Mapping
from typing import Any, Final

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.io.formats.documents import commented_yaml
from calibgraph.io.formats.rig_export import (
    COVARIANCE_SENTENCE,
    RigExport,
    carried_coefficients,
    frame_id,
    no_place_for,
)
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.geometry import relative_transform
from calibgraph.model.rig import Camera

DERIVED = "computed from T_cam_lidar"
"""States of a T_cn_cnm1 that it is no measurement."""
_MODELS: Final = {"pinhole": "plumb_bob", "fisheye": "equidistant", "omnidirectional": "mei"}
_PLUMB_BOB = 5
_SAME = 1e-9  # of rotation matrices: rounding in double precision
_MOST = 4
_MAPS = f"T_camera_lidar maps LiDAR to camera coordinates: {FRAMES_SENTENCE}"


def write_kalibr(export: RigExport) -> str:
    """A camchain: cam0, cam1, ... in the order of the rig."""
    names = list(export.cameras)
    content = {f"cam{i}": _of_kalibr(export, names, i) for i in range(len(names))}
    statement = export.statement(
        "T_cam_lidar maps LiDAR to camera coordinates: p_camera = T_cam_lidar * p_lidar",
        "T_cn_cnm1 of cam n maps coordinates of cam n-1 to those of cam n",
        f"cameras: {', '.join(f'cam{i} is {name}' for i, name in enumerate(names))}; "
        "correct the rostopics",
        COVARIANCE_SENTENCE,
    )
    return commented_yaml(statement, content)


def _of_kalibr(export: RigExport, names: list[str], index: int) -> dict[str, Any]:
    name = names[index]
    camera, covariance = export.cameras[name], export.ros_covariance(name)
    content = {
        **_projection(name, camera),
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{name}/image_raw",
    }
    own: dict[str, Any] = {"camera": name}
    if index:
        before = export.cameras[names[index - 1]]
        content["T_cn_cnm1"] = relative_transform(camera.T_camera_lidar, before.T_camera_lidar)
        own["T_cn_cnm1"] = DERIVED
    content["T_cam_lidar"] = camera.T_camera_lidar
    if camera.time_offset_s is not None:  # the LiDAR's time of an image is the camera's plus it
        content["timeshift_cam_lidar"] = camera.time_offset_s
    if covariance is not None:
        own["covariance"] = covariance.ravel()
    return {**content, "calibgraph": own}


def _projection(name: str, camera: Camera) -> dict[str, Any]:
    intrinsics = [*camera.intrinsics_px.model_dump().values()]
    model, distortion, coefficients = "pinhole", "radtan", [*camera.distortion]
    if camera.model == "equirectangular":
        raise no_place_for(name, camera, "Kalibr's camchain")
    if camera.model == "omnidirectional":
        model, intrinsics, coefficients = "omni", [coefficients[0], *intrinsics], coefficients[1:]
    elif camera.model == "fisheye":
        distortion = "equidistant"
    elif any(coefficients):
        coefficients = carried_coefficients(name, camera, 4, "Kalibr's radtan")
    else:
        distortion, coefficients = "none", []
    return {
        "camera_model": model,
        "intrinsics": intrinsics,
        "distortion_model": distortion,
        "distortion_coeffs": coefficients,
    }


def write_kitti(export: RigExport) -> str:
    """P_k = K [I | b] per camera and Tr; without comments, at which readers of others stop.

    Raises:
        CalibrationError: if a lens is distorted, or cameras differ in their rotation.
    """
    numbers = _numbers(export)
    first, *_ = export.cameras.values()
    Tr = first.T_camera_lidar[:3]
    lines = []
    for name, camera in export.cameras.items():
        if camera.model != "pinhole":
            raise no_place_for(name, camera, "KITTI's calib.txt")
        carried_coefficients(name, camera, 0, "KITTI's calib.txt")
        if np.abs(camera.T_camera_lidar[:3, :3] - Tr[:, :3]).max() > _SAME:
            raise CalibrationError(
                f"camera {name!r}: KITTI's calib.txt has one rotation for all cameras, and this "
                "one differs from the first; write one file per camera with --camera",
                camera=name,
            )
        b = camera.T_camera_lidar[:3, 3:] - Tr[:, 3:]
        P = camera.matrix_px @ np.hstack([np.eye(3), b])
        lines.append(_line(f"P{numbers[name]}", P))
    return "".join([*sorted(lines), _line("Tr", Tr)])


def kitti_statement(export: RigExport) -> list[str]:
    """The direction, for a file beside calib.txt."""
    numbers = _numbers(export)
    return export.statement(
        "calib.txt: the pixel of p_lidar is P_k * [Tr; 0 0 0 1] * p_lidar, with P_k = K [I | b]; "
        "Tr maps LiDAR to rectified camera coordinates",
        "T_camera_lidar of camera k is Tr with K^-1 P_k[:, 3] added to its translation",
        f"cameras: {', '.join(f'{name} is P{k}' for name, k in numbers.items())}",
    )


def _numbers(export: RigExport) -> dict[str, int]:
    """The k of P_k per camera: the number in image_k, else its place in the order."""
    found = {name: re.fullmatch(r"image_0?([0-3])", name) for name in export.cameras}
    numbers = {name: int(match[1]) for name, match in found.items() if match}
    if len(set(numbers.values())) == len(export.cameras):
        return numbers
    if len(export.cameras) > _MOST:
        raise CalibrationError(
            f"KITTI's calib.txt holds {_MOST} cameras, these are {len(export.cameras)}; choose "
            "some with --camera"
        )
    return {name: k for k, name in enumerate(export.cameras)}


def _line(key: str, matrix: Array) -> str:
    return f"{key}: {' '.join(repr(float(value)) for value in matrix.ravel())}\n"


def write_camera_infos(export: RigExport) -> Mapping[str, str]:
    """Per name of a file, the lens of one camera, as ROS's ``camera_info_manager`` loads it.

    K and D are of the images as recorded; R is the identity and P is K.

    Raises:
        CalibrationError: if a lens has no name in ROS, or two cameras one name of a file.
    """
    files: dict[str, str] = {}
    for name, camera in export.cameras.items():
        file = f"{frame_id(name)}.yaml"
        if file.casefold() in map(str.casefold, files):  # one file where systems ignore case
            raise CalibrationError(f"camera {name!r}: another has the file {file}; rename one")
        statement = (
            export.origin,
            "K and D are of the images as recorded, R is the identity, P is K",
            "the extrinsic is not part of a camera_info: export it as ros2-launch or urdf",
            f"optical frame: {export.optical_frames[name]}",
        )
        files[file] = commented_yaml(statement, _of_ros(name, camera))
    return files


def _of_ros(name: str, camera: Camera) -> dict[str, Any]:
    K, distortion = camera.matrix_px, [*camera.distortion]
    if camera.model == "pinhole":
        distortion += [0.0] * (_PLUMB_BOB - len(distortion))
    is_rational = camera.model == "pinhole" and len(distortion) > _PLUMB_BOB
    model = "rational_polynomial" if is_rational else _MODELS.get(camera.model)
    if model is None:
        raise no_place_for(name, camera, "ROS's camera_info")
    return {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": frame_id(name),
        "camera_matrix": _matrix(K),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([K, np.zeros(3)])),
    }


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def write_json(export: RigExport) -> str:
    """Per camera: lens, both directions of the extrinsic, covariance or null."""
    content = {
        "calibgraph_export": export.statement(
            _MAPS,
            "T_lidar_camera is its inverse, the pose of the camera in the LiDAR frame",
            COVARIANCE_SENTENCE,
        ),
        "verdict": export.verdict or None,
        "lidar_frame": export.lidar_frame,
        "cameras": {name: _of_json(export, name) for name in export.cameras},
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _of_json(export: RigExport, name: str) -> dict[str, Any]:
    camera, covariance = export.cameras[name], export.ros_covariance(name)
    if camera.frame_id is not None:
        camera = camera.model_copy(update={"frame_id": export.optical_frames[name]})
    return {
        **camera.model_dump(),
        "optical_frame": export.optical_frames[name],
        "T_lidar_camera": export.T_lidar_camera(name).tolist(),
        "covariance": None if covariance is None else covariance.ravel().tolist(),
    }


def write_opencv(export: RigExport) -> str:
    """Maps camera_0, camera_1, ... in the order of the rig, written by OpenCV itself."""
    file = cv2.FileStorage("rig.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for line in export.statement(_MAPS, COVARIANCE_SENTENCE):
        file.writeComment(line, False)
    for index, (name, camera) in enumerate(export.cameras.items()):
        file.startWriteStruct(f"camera_{index}", cv2.FileNode_MAP)
        file.write("name", name)
        file.write("model", camera.model)
        file.write("fisheye_model", int(camera.model == "fisheye"))
        file.write("image_width", camera.width_px)
        file.write("image_height", camera.height_px)
        file.write("camera_matrix", camera.matrix_px)
        distortion = [*camera.distortion] or [0.0] * 5
        if camera.model == "omnidirectional":  # OpenCV's omnidir keeps xi apart
            xi, *distortion = camera.distortion
            file.write("xi", xi)
        file.write("distortion_coefficients", np.array(distortion)[None])
        file.write("T_camera_lidar", np.array(camera.T_camera_lidar))
        for key in ("time_offset_s", "readout_s"):
            if (seconds := getattr(camera, key)) is not None:
                file.write(key, seconds)
        covariance = export.ros_covariance(name)
        if covariance is not None:
            file.write("covariance", covariance)
        file.endWriteStruct()
    return str(file.releaseAndGetString())
