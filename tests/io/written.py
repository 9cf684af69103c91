"""A cloud, and data sets as KITTI publishes them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.conftest import make_camera

CLOUD = np.random.default_rng(0).normal(size=(500, 4)).astype(np.float32)


def written_kitti(folder: Path, frames: int = 2) -> Path:
    """A KITTI odometry sequence with two cameras and known numbers."""
    (folder / "velodyne").mkdir(parents=True)
    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    lines = []
    for k in range(4):
        b = np.array([[-0.5 * k], [0.01 * k], [0.002 * k]])
        lines.append(f"P{k}: " + " ".join(map(str, (K @ np.hstack([np.eye(3), b])).ravel())))
    Tr = np.hstack([make_camera((0.27, 0.0, -0.08)).T_camera_lidar[:3]])
    lines.append("Tr: " + " ".join(map(str, Tr.ravel())))
    (folder / "calib.txt").write_text("\n".join(lines))
    for k in (2, 3):
        (folder / f"image_{k}").mkdir()
        for i in range(frames):
            image = np.full((370, 1226, 3), 40 * k, np.uint8)
            cv2.imwrite(str(folder / f"image_{k}" / f"{i:06}.png"), image)
    for i in range(frames):
        CLOUD.tofile(folder / "velodyne" / f"{i:06}.bin")
    return folder


RECTIFY = Rotation.from_euler("xyz", [0.4, -0.3, 0.5], degrees=True).as_matrix()


T_CAMERA0_LIDAR = make_camera((0.27, 0.0, -0.08), yaw_deg=0.5).T_camera_lidar


BASELINES = {"02": [0.06, 0.001, 0.003], "03": [-0.47, 0.002, 0.003]}


def text_of(name: str, values: np.ndarray) -> str:
    return f"{name}: " + " ".join(f"{value:.15e}" for value in np.ravel(values))
