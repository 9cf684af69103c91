"""When the rows of an image are taken, and where points of a static world are then.

A LiDAR with the twist xi = (w, v) sees a point p, t later, at exp(-xi t) p, which moves by
-(w x p + v). The error of the constant twist grows with t^2: 5 mm in 0.1 s at 1 m/s^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_RAD = 1e-4  # of turn, below which the series are as exact


@dataclass(frozen=True)
class Clock:
    """When a camera takes the rows of an image, after the points that they are compared with.

    Attributes:
        offset_s: of the middle row.
        readout_s: from the first row to the last; 0 of a global shutter.
        height_px: of the image.
    """

    offset_s: float = 0.0
    readout_s: float = 0.0
    height_px: int = 1

    def shares(self, rows_px: Array) -> Array:
        """(n,) part of the read-out between the middle of the image and a row, -1/2 to 1/2."""
        return np.asarray((rows_px + 0.5) / self.height_px - 0.5)

    def times_s(self, rows_px: Array) -> Array:
        """(n,) when rows are taken."""
        return self.offset_s + self.readout_s * self.shares(rows_px)


def displace(points_m: Array, twists_per_s: Array, seconds: ArrayLike) -> Array:
    """(n, 3) points moved by exp(xi t).

    Args:
        points_m: (n, 3).
        twists_per_s: (6,) or (n, 6) rotation [rad/s] and translation [m/s].
        seconds: t, a number or (n,).
    """
    w, v = np.split(np.atleast_2d(twists_per_s), 2, axis=1)
    first, second, third = _integrals(np.asarray(seconds, np.float64), np.linalg.norm(w, axis=1))
    turned, turned_v = np.cross(w, points_m), np.cross(w, v)
    return np.asarray(
        points_m + first * turned + second * np.cross(w, turned)
        + np.reshape(seconds, (-1, 1)) * v + second * turned_v + third * np.cross(w, turned_v)
    )  # fmt: skip


def _integrals(t: Array, rate: Array) -> tuple[Array, Array, Array]:
    """(n, 1) sin(a) / r, (1 - cos a) / r^2 and (a - sin a) / r^3 of a = r t."""
    angle = rate * t
    small = np.abs(angle) < _SMALL_RAD
    r = np.where(small, 1.0, rate)
    parts = (
        np.where(small, t, np.sin(angle) / r),
        np.where(small, t**2 / 2, (1 - np.cos(angle)) / r**2),
        np.where(small, t**3 / 6, (angle - np.sin(angle)) / r**3),
    )
    return parts[0][:, None], parts[1][:, None], parts[2][:, None]
