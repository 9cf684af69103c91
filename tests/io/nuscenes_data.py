"""A dataset as a nuScenes folder, by the tables' published schema."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph import Dataset

T_EGO_LIDAR = np.eye(4)
T_EGO_LIDAR[:3, :3] = Rotation.from_euler("z", -90, degrees=True).as_matrix()  # x to the right
T_EGO_LIDAR[:3, 3] = 0.94, 0.0, 1.84
START_US, PERIOD_US = 1_532_402_927_000_000, 500_000
Tables = dict[str, list[dict[str, Any]]]


def pose(T: np.ndarray) -> dict[str, Any]:
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"translation": T[:3, 3].tolist(), "rotation": [w, x, y, z]}


def tables_of(data: Dataset, *, scene: str = "scene-0001", moved_m: float = 0.0) -> Tables:
    """The tables; the vehicle moves so far between a scan and its images."""
    sensors = {"LIDAR_TOP": "lidar", **dict.fromkeys(data.rig.cameras, "camera"), "RADAR": "radar"}
    poses = {"LIDAR_TOP": T_EGO_LIDAR, "RADAR": np.eye(4)}
    for name, camera in data.rig.cameras.items():
        poses[name] = T_EGO_LIDAR @ np.linalg.inv(camera.T_camera_lidar)
    tables: Tables = {
        "sensor": [
            {"token": f"s-{name}", "channel": name, "modality": kind}
            for name, kind in sensors.items()
        ],
        "calibrated_sensor": [
            {
                "token": f"{scene}-{name}", "sensor_token": f"s-{name}", **pose(T),
                "camera_intrinsic": data.rig.cameras[name].matrix_px.tolist()
                if name in data.rig.cameras else [],
            }
            for name, T in poses.items()
        ],
        "scene": [{"token": scene, "name": scene, "log_token": "log"}],
        "sample": [], "sample_data": [], "ego_pose": [],
    }  # fmt: skip
    for number, frame in enumerate(data.frames):
        stamp, sample = START_US + number * PERIOD_US, f"{scene}-{number}"
        tables["sample"].append({"token": sample, "timestamp": stamp, "scene_token": scene})
        files = {"LIDAR_TOP": f"{sample}.pcd.bin", "RADAR": f"{sample}.pcd"}
        files |= {name: f"{sample}{path.suffix}" for name, path in frame.image_paths.items()}
        for name, file in files.items():
            camera = data.rig.cameras.get(name)
            tables["ego_pose"].append(
                {"token": f"{sample}-{name}", "timestamp": stamp,
                 "translation": [10.0 * number + moved_m * (camera is not None), 0.0, 0.0],
                 "rotation": [1.0, 0.0, 0.0, 0.0]}
            )  # fmt: skip
            record = {
                "sample_token": sample, "ego_pose_token": f"{sample}-{name}",
                "calibrated_sensor_token": f"{scene}-{name}", "timestamp": stamp,
                "filename": f"samples/{name}/{file}", "fileformat": "pcd",
                "width": camera.width_px if camera else 0,
                "height": camera.height_px if camera else 0,
            }  # fmt: skip
            sweep = {"token": f"{sample}-{name}-sweep", "is_key_frame": False, **record}
            tables["sample_data"] += [
                {"token": f"{sample}-{name}-data", "is_key_frame": True, **record},
                {**sweep, "filename": f"sweeps/{name}/{file}"},
            ]
    return tables


def write_files(folder: Path, data: Dataset, scene: str = "scene-0001") -> None:
    """Scans of x y z intensity ring, and images."""
    for number, frame in enumerate(data.frames):
        scan = folder / "samples" / "LIDAR_TOP" / f"{scene}-{number}.pcd.bin"
        scan.parent.mkdir(parents=True, exist_ok=True)
        cloud = frame.load_cloud()
        ring = np.arange(len(cloud), dtype=np.float32) % 32
        np.column_stack([cloud, ring]).astype("<f4").tofile(scan)
        for name, path in frame.image_paths.items():
            image = folder / "samples" / name / f"{scene}-{number}{path.suffix}"
            image.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, image)


def write_tables(folder: Path, *parts: Tables, version: str = "v1.0-mini") -> None:
    """Write the tables; records of several scenes one after another, sensors once."""
    (folder / version).mkdir(parents=True, exist_ok=True)
    for table in parts[0]:
        records = {each["token"]: each for part in parts for each in part[table]}
        (folder / version / f"{table}.json").write_text(json.dumps(list(records.values())))
