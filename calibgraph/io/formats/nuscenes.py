"""nuScenes' table calibrated_sensor: sensor -> ego, quaternions w x y z, undistorted images."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.formats.lenses import require_undistorted
from calibgraph.io.formats.rig_export import RigExport
from calibgraph.io.rotations import quaternion_xyzw


def write_nuscenes(export: RigExport) -> str:
    """One record per camera and one of the LiDAR, whose frame is ego's without ``--lidar-pose``."""
    T_base_lidar = np.eye(4) if export.T_base_lidar is None else export.T_base_lidar
    ego = "the LiDAR frame, as no --lidar-pose was given" if export.T_base_lidar is None else (
        "where --lidar-pose puts it"
    )  # fmt: skip
    statement = export.statement(
        "translation and rotation (w x y z) are the pose of the sensor in ego: "
        "p_ego = R(rotation) * p_sensor + translation",
        f"ego is {ego}; tokens are the names of the sensors",
    )
    records = [_record(export.lidar_frame, T_base_lidar, [])]
    for name, camera in export.cameras.items():
        require_undistorted(name, camera, "nuScenes' calibrated_sensor")
        records.append(_record(name, export.T_base_camera(name), camera.matrix_px.tolist()))
    records[0]["calibgraph_export"] = statement
    return json.dumps(records, indent=2, allow_nan=False) + "\n"


def _record(name: str, T_ego_sensor: NDArray[np.float64], matrix: list[Any]) -> dict[str, Any]:
    x, y, z, w = quaternion_xyzw(T_ego_sensor)
    return {
        "token": name,
        "sensor_token": name,
        "translation": T_ego_sensor[:3, 3].tolist(),
        "rotation": [w, x, y, z],
        "camera_intrinsic": matrix,
    }
