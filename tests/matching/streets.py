"""Scans of a street, from any pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calibgraph.simulation.lidar import lidar_of, ring_gains, scan
from calibgraph.simulation.recording import Drive

Array = NDArray[np.float64]
_LIDAR = replace(lidar_of(64), azimuth_step_deg=0.5)
_GAINS = ring_gains(_LIDAR, np.random.default_rng(0))


def scan_at(drive: Drive, T_world_lidar: Array, seed: int) -> NDArray[np.float32]:
    """(n, 4) the cloud of a 64-beam LiDAR with few columns."""
    return scan(drive.world, _LIDAR, _GAINS, T_world_lidar, rng=np.random.default_rng(seed))


def displaced(T_world_lidar: Array, *, left_m: float, turned_deg: float) -> Array:
    """(4, 4) the pose beside a stop."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", turned_deg, degrees=True).as_matrix()
    T[1, 3] = left_m
    return T_world_lidar @ T
