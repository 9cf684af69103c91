"""Plain JSON and OpenCV FileStorage: extrinsics, lenses, covariance."""

from typing import Any

import cv2
import numpy as np

from calibgraph.io.formats.documents import stated_json
from calibgraph.io.formats.rig_export import COVARIANCE_SENTENCE, RigExport
from calibgraph.model.calibration import FRAMES_SENTENCE

_DIRECTION = (
    f"T_camera_lidar maps LiDAR to camera coordinates: {FRAMES_SENTENCE}",
    "T_lidar_camera is its inverse, the pose of the camera in the LiDAR frame",
    COVARIANCE_SENTENCE,
)


def write_json(export: RigExport) -> str:
    """Per camera: lens, both directions of the extrinsic, covariance or null."""
    content = {
        "verdict": export.verdict or None,
        "lidar_frame": export.lidar_frame,
        "cameras": {name: _content(export, name) for name in export.cameras},
    }
    return stated_json(export.statement(*_DIRECTION), content)


def _content(export: RigExport, name: str) -> dict[str, Any]:
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
    direction = f"T_camera_lidar maps LiDAR to camera coordinates: {FRAMES_SENTENCE}"
    for line in export.statement(direction, COVARIANCE_SENTENCE):
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
