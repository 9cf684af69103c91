"""Motion during a scan: points as if all were taken at one instant, at constant velocity.

In LiDAR axes the vehicle has the twist xi = (w, v); a point p_t that was taken dt after the instant
is exp(xi dt) p_t there. The points of a scan are 0.1 s apart at most: an acceleration of 2 m/s^2
leaves 1 cm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import DatasetError
from calibgraph.model.geometry import invert
from factors import displace

_COARSE_M, _FINE_M = 1.0, 0.25
_REACHES_M = 4.0, 1.0  # of both registrations: 40 m/s in 0.1 s
PreparedScan = tuple[tuple[Any, Any], tuple[Any, Any]]
"""A thinned cloud of small_gicp and its tree, coarse and fine."""


@dataclass(frozen=True)
class ScanMotion:
    """How the LiDAR moves during a scan, and the instant for which its points are wanted.

    Attributes:
        twist_per_s: rotation [rad/s] and translation [m/s] along the LiDAR's axes.
        to_s: the instant, in seconds after the stamp of the scan.
        T_world_lidar: (4, 4) at the stamp, if poses of the drive are given; not kept in results.
    """

    twist_per_s: tuple[float, ...]
    to_s: float
    T_world_lidar: Array | None = field(default=None, compare=False, repr=False)

    def correct(self, points_m: NDArray[np.floating], times_s: Array) -> Array:
        """(n, 3) where points, taken at times [s] after the stamp, would be seen at the instant."""
        points = points_m.astype(np.float64)
        return displace(points, np.array(self.twist_per_s), times_s - self.to_s)

    def entry(self) -> dict[str, Any]:
        """As a result keeps it."""
        return {"twist_per_s": list(self.twist_per_s), "to_s": self.to_s}

    @staticmethod
    def of_entry(entry: Mapping[str, Any]) -> ScanMotion:
        """Of what :meth:`entry` gave."""
        return ScanMotion(tuple(entry["twist_per_s"]), entry["to_s"])


def twist_between(T_world_before: Array, T_world_after: Array, seconds: float) -> Array:
    """(6,) rotation [rad/s] and translation [m/s] per second, from two (4, 4) poses."""
    step = gtsam.Pose3(invert(T_world_before) @ T_world_after)
    return np.asarray(gtsam.Pose3.Logmap(step) / seconds, dtype=np.float64)


def prepare_scan(points_m: Array) -> PreparedScan:
    """Thin a scan, (n, 3), for :func:`register`; this takes longer than the registration."""
    import small_gicp

    coarse, fine = (small_gicp.preprocess_points(points_m, size) for size in (_COARSE_M, _FINE_M))
    return coarse, fine


def register(target: PreparedScan, source: PreparedScan, where: Path) -> Array:
    """(4, 4) T_target_source of two scans, coarse and then fine.

    Raises:
        DatasetError: if they do not fit.
    """
    import small_gicp

    T = np.eye(4)
    for (cloud, tree), (moved, _), reach_m in zip(target, source, _REACHES_M, strict=True):
        found = small_gicp.align(cloud, moved, tree, T, max_correspondence_distance=reach_m)
        T = np.asarray(found.T_target_source)
    if not found.converged:
        raise DatasetError(
            f"{where}: its scan and a neighbouring one do not fit, so that the motion is "
            "unknown; take neighbouring clouds of one drive, or leave --interval-s or --motion out"
        )
    return T
