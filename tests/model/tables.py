"""Small tables of correspondences and of camera matches."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibgraph import Correspondences
from calibgraph.model.camera_matches import CameraMatches

to_arrow = Correspondences.to_arrow


def table(**changes: Any) -> Correspondences:
    """Four correspondences of two cameras and two frames."""
    columns: dict[str, Any] = {
        "camera": ["left", "left", "right", "left"],
        "frame": [0, 1, 1, 1],
        "pixels_px": [[600, 180], [610, 190], [500, 200], [610.4, 190.3]],
        "points_lidar_m": [[10, 0, 0], [9, 0, 0], [10, -1, 0], [20, 0, 0]],
        "confidence": [0.9, 0.8, 1.0, 0.7],
    }
    return Correspondences.from_arrays(**(columns | changes))


CAMERAS = ("left", "right", "rear")


NAN = np.nan


def camera_matches(**changes: Any) -> CameraMatches:
    """Three matches of two pairs; planes on both sides, one side, and none."""
    planes = np.full((3, 2, 3), NAN)
    planes[0], planes[1, 0] = [[0.1, 0, 0], [0.2, 0.01, 0]], [0.05, 0, 0.1]
    columns: dict[str, Any] = {
        "cameras": CAMERAS,
        "camera_index": np.array([[0, 1], [0, 1], [1, 2]], np.int32),
        "frame": np.array([4, 5, 5]),
        "pixels_px": np.arange(12.0).reshape(3, 2, 2),
        "planes_lidar_per_m": planes,
        "metadata": {"camera_features": "sift"},
    }
    return CameraMatches(**(columns | changes))
