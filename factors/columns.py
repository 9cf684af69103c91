"""Columns beside the pose: parameters of a lens, of a clock, and of the distortion of a scan.

A derivative of the pixels by each stands beside those by the pose. Every lens here maps to
u = fx a + cx, v = fy b + cy, and (a, b) is linear in the coefficients that may be free.

A LiDAR with the twist xi = (w, v) sees a point p of a static world, t later, at exp(-xi t) p, which
moves by -(w x p + v): so the column of a clock is those by the pose, times the twist. The error of
a constant twist grows with t^2: 5 mm in 0.1 s at 1 m/s^2.

A rigid motion of the cloud moves all cameras alike. Three errors of recorded scans do not: beams
that all point higher or lower than is stated, which pitch the cloud along every line of sight;
beams that are spread too far or too little from the horizon; and motion during a turn, which
displaces each heading by another amount. The turn begins and ends behind: a point straight ahead is
where it is reported, one behind is half of the motion off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors import kernel
from factors.arrays import read_only
from factors.lens import Lens
from factors.lens_kernels import FISHEYE, OMNIDIRECTIONAL, PINHOLE
from factors.pose_kernel import exponential_times

Array = NDArray[np.float64]

COEFFICIENT_NUMBERS: Mapping[int, Mapping[str, int]] = {
    PINHOLE: {"k1": 0, "k2": 1, "p1": 2, "p2": 3, "k3": 4},
    FISHEYE: {"k1": 0, "k2": 1, "k3": 2, "k4": 3},
    OMNIDIRECTIONAL: {"k1": 1, "k2": 2, "p1": 3, "p2": 4},
}
"""By the kind of lens, the distortion coefficients that may be free, and their places."""

LENS = FOCAL, ASPECT, CENTRE_X, CENTRE_Y = "focal", "aspect", "centre_x", "centre_y"
CLOCK = OFFSET, READOUT = "offset", "readout"
DISTORTION = ELEVATION, STRETCH, MOTION = "elevation", "stretch", "motion"

_NUMBERS = {name: number for number, name in enumerate(LENS)} | {
    **dict.fromkeys((*CLOCK, *DISTORTION), kernel.DISPLACED),
    "p1": kernel.P1,
    "p2": kernel.P2,
    **{f"k{power}": kernel.P2 + power for power in range(1, 5)},
}


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

    def times_s(self, rows_px: Array) -> Array:
        """(n,) when rows are taken."""
        share = (rows_px + 0.5) / self.height_px - 0.5  # of the read-out, from the middle
        return np.asarray(self.offset_s + self.readout_s * share)


def displace(points_m: Array, twists_per_s: Array, seconds: ArrayLike) -> Array:
    """(n, 3) points moved by exp(xi t).

    Args:
        points_m: (n, 3).
        twists_per_s: (6,) or (n, 6) rotation [rad/s] and translation [m/s].
        seconds: t, a number or (n,).
    """
    steps = np.empty((len(points_m), 6))
    steps[:] = np.reshape(seconds, (-1, 1)) * twists_per_s
    T = np.tile(np.eye(4), (len(steps), 1, 1))
    exponential_times(steps, T)
    return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], points_m) + T[:, :3, 3])


@dataclass(frozen=True, eq=False)
class Columns:
    """A lens, a clock and the parameters that are columns, in standard deviations of their priors.

    Attributes:
        lens: at the mean of the prior, where all values are zero.
        parameters: (k,) names: ``focal`` [of the logarithm of both focal lengths], ``aspect`` [of
            the logarithm of fx / fy], ``centre_x`` and ``centre_y`` [px], distortion coefficients
            as in ``COEFFICIENT_NUMBERS``; ``offset`` and ``readout`` [s] of the clock;
            ``elevation`` [rad], ``stretch`` [of the elevations] and ``motion`` [m] of the scan.
        sigmas: (k,) their standard deviations.
        clock: at the mean of the prior.

    Raises:
        ValueError: if the kind of lens has no such parameter.
    """

    lens: Lens
    parameters: tuple[str, ...] = ()
    sigmas: tuple[float, ...] = ()
    clock: Clock = Clock()

    def __post_init__(self) -> None:
        known = [*LENS, *COEFFICIENT_NUMBERS[self.lens.kind]]
        unknown = [name for name in self.parameters if name not in (*known, *CLOCK, *DISTORTION)]
        if unknown:
            raise ValueError(f"this lens has no free {', '.join(unknown)}")

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def packed(self) -> tuple[NDArray[np.int64], Array]:
        """(k,) numbers of the parameters for the kernel, and (k,) their units."""
        numbers = [_NUMBERS[name] for name in self.parameters]
        return read_only(np.array(numbers, np.int64)), read_only(np.array(self.sigmas))

    def displacements(self, points_lidar_m: Array, rows_px: Array, twists_per_s: Array) -> Array:
        """(m, 3, n) of points in the LiDAR frame by a unit of each parameter that displaces them.

        Args:
            points_lidar_m: (3, n) where they are when their pixels are taken.
            rows_px: (n,) of the pixels.
            twists_per_s: (6, n) of the LiDAR, or (0, n) if it is unknown.
        """
        names = [name for name in self.parameters if name in (*CLOCK, *DISTORTION)]
        found = np.zeros((len(names), 3, len(rows_px)))
        x, y, z = points_lidar_m
        for move, name in zip(found, names, strict=True):
            if name in CLOCK and len(twists_per_s):
                share = (
                    1.0
                    if name == OFFSET
                    else replace(self.clock, offset_s=0.0, readout_s=1.0).times_s(rows_px)
                )
                turned = np.cross(twists_per_s[:3], points_lidar_m, axis=0)
                move[:] = -share * (turned + twists_per_s[3:])
            elif name in DISTORTION:
                heading, level = np.arctan2(y, x), np.hypot(x, y)
                size = np.arctan2(z, level) if name == STRETCH else 1.0
                move[0] = heading / (2 * np.pi)
                if name != MOTION:
                    move[:] = size * np.stack([-z * np.cos(heading), -z * np.sin(heading), level])
        return found

    def at(self, values: Array) -> Lens:
        """The lens of (k,) values."""
        steps = self._steps(values)
        if steps.keys() <= {*CLOCK, *DISTORTION}:
            return self.lens
        packed, half = self.lens.packed.copy(), 0.5 * steps.get(ASPECT, 0.0)
        packed[:2] *= np.exp(steps.get(FOCAL, 0.0) + np.array([half, -half]))
        packed[2:4] += steps.get(CENTRE_X, 0.0), steps.get(CENTRE_Y, 0.0)
        for name, number in COEFFICIENT_NUMBERS[self.lens.kind].items():
            packed[4 + number] += steps.get(name, 0.0)
        return Lens.limited(self.lens.kind, packed)

    def clock_at(self, values: Array) -> Clock:
        """The clock of (k,) values."""
        steps, clock = self._steps(values), self.clock
        return replace(
            clock,
            offset_s=clock.offset_s + steps.get(OFFSET, 0.0),
            readout_s=clock.readout_s + steps.get(READOUT, 0.0),
        )

    def _steps(self, values: Array) -> dict[str, float]:
        """By name, the differences from the mean of the prior."""
        return dict(zip(self.parameters, np.multiply(values, self.sigmas).tolist(), strict=True))
