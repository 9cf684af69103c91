"""Motion during a scan: points as if all were taken at one instant, at constant velocity.

In LiDAR axes the vehicle has the twist xi = (w, v); a point p_t that was taken dt after the instant
is exp(xi dt) p_t there. The points of a scan are 0.1 s apart at most: an acceleration of 2 m/s^2
leaves 1 cm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert

_STILL_RAD = 1e-6  # of turn, below which the series are as exact


@dataclass(frozen=True)
class ScanMotion:
    """How the LiDAR moves during a scan, and the instant for which its points are wanted.

    Attributes:
        twist_per_s: rotation [rad/s] and translation [m/s] along the LiDAR's axes.
        to_s: the instant, in seconds after the stamp of the scan.
    """

    twist_per_s: tuple[float, ...]
    to_s: float

    def correct(self, points_m: NDArray[np.floating], times_s: Array) -> Array:
        """(n, 3) where points, taken at times [s] after the stamp, would be seen at the instant."""
        w, v = np.array(self.twist_per_s[:3]), np.array(self.twist_per_s[3:])
        points = points_m.astype(np.float64)
        first, second, third = _integrals(times_s - self.to_s, float(np.linalg.norm(w)))
        turned = np.cross(w, points)
        turned_v = np.cross(w, v)
        moved: Array = (
            points + first * turned + second * np.cross(w, turned)
            + (times_s - self.to_s)[:, None] * v + second * turned_v + third * np.cross(w, turned_v)
        )  # fmt: skip
        return moved

    def entry(self) -> dict[str, Any]:
        """As a result keeps it."""
        return {"twist_per_s": list(self.twist_per_s), "to_s": self.to_s}

    @staticmethod
    def of_entry(entry: Mapping[str, Any]) -> ScanMotion:
        """Of what :meth:`entry` gave."""
        return ScanMotion(tuple(entry["twist_per_s"]), entry["to_s"])


def _integrals(dt: Array, rate: float) -> tuple[Array, Array, Array]:
    """(n, 1) sin(a) / r, (1 - cos a) / r^2 and (a - sin a) / r^3 of a = r dt."""
    dt = dt[:, None]
    if rate * np.abs(dt).max(initial=0.0) < _STILL_RAD:
        return dt, dt**2 / 2, dt**3 / 6
    angle = rate * dt
    sine = np.sin(angle)
    return sine / rate, (1 - np.cos(angle)) / rate**2, (angle - sine) / rate**3


def twist_between(T_world_before: Array, T_world_after: Array, seconds: float) -> Array:
    """(6,) rotation [rad/s] and translation [m/s] per second, from two (4, 4) poses."""
    step = gtsam.Pose3(invert(T_world_before) @ T_world_after)
    return np.asarray(gtsam.Pose3.Logmap(step) / seconds, dtype=np.float64)
