"""Checkpoints and clouds that several tests of the learned matcher build."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from calibgraph import Camera
from calibgraph.matching.cmrnext.network import Architecture, CmrNext

CONFIG = {
    "use_reflectance": False,
    "normalize_images": True,
    "max_depth": 160.0,
    "upsample_method": "transposed",
    "fourier_levels": 12,
    "context_encoder": "lidar",
    "uncertainty": False,
    "max_r": 1.0,
    "max_t": 0.1,
}


def good_content(**config: Any) -> dict[str, Any]:
    """The content of a checkpoint with an untrained network of width 8."""
    torch.manual_seed(0)
    state = CmrNext(Architecture(width=8)).state_dict()
    return {"config": CONFIG | config, "epoch": 150, "state_dict": state, "train_loss": 0.5}


def saved(path: Path, content: Any) -> Path:
    torch.save(content, path)
    return path


def cloud_before(camera: Camera, count: int) -> NDArray[np.float32]:
    """(n, 4) points in front of a camera, in the LiDAR frame."""
    rng = np.random.default_rng(0)
    pixels = rng.uniform([5, 5], [camera.width_px - 5, camera.height_px - 5], (count, 2))
    depth = rng.uniform(4, 60, (count, 1))
    k = camera.intrinsics_px
    plane = (pixels - [k.cx, k.cy]) / [k.fx, k.fy]
    points = np.column_stack([plane * depth, depth])
    T = np.linalg.inv(camera.T_camera_lidar)
    lidar = points @ T[:3, :3].T + T[:3, 3]
    return np.column_stack([lidar, rng.uniform(0, 1, count)]).astype(np.float32)
