"""A lens and a clock with free parameters, and the block factor on a pose and these.

With k free parameters l, the lossless block factor of ``factors.block`` has 6 + k columns: a
derivative of the pixels by each parameter stands beside those by the pose. Every model here maps to
u = fx a + cx, v = fy b + cy, and (a, b) is linear in the coefficients that may be free, so that all
derivatives are products of known numbers. A later image shows points that have moved on: its
derivatives are those by the pose, times the twist of the LiDAR.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from factors.block import ProjectionBlock
from factors.block_arrays import whiten
from factors.block_sums import BlockSums, square_root
from factors.clock import Clock, displace
from factors.custom import custom_factor
from factors.lens import Lens
from factors.lens_kernels import EQUIRECTANGULAR, FISHEYE, OMNIDIRECTIONAL, PINHOLE
from factors.loss import loss_id, losses_and_weights

Array = NDArray[np.float64]

COEFFICIENT_NUMBERS: Mapping[int, Mapping[str, int]] = {
    PINHOLE: {"k1": 0, "k2": 1, "p1": 2, "p2": 3, "k3": 4},
    FISHEYE: {"k1": 0, "k2": 1, "k3": 2, "k4": 3},
    OMNIDIRECTIONAL: {"k1": 1, "k2": 2, "p1": 3, "p2": 4},
    EQUIRECTANGULAR: {},
}
"""By the kind of lens, the distortion coefficients that may be free, and their places."""

FOCAL, ASPECT, CENTRE_X, CENTRE_Y = "focal", "aspect", "centre_x", "centre_y"
OFFSET, READOUT = CLOCK = "offset", "readout"

_MAKERS: Mapping[int, tuple[Callable[..., Lens], int]] = {
    PINHOLE: (Lens.pinhole, 8),
    FISHEYE: (Lens.fisheye, 4),
    OMNIDIRECTIONAL: (Lens.omnidirectional, 5),
}


@dataclass(frozen=True, eq=False)
class FreeLens:
    """A lens, a clock and their free parameters, each in standard deviations of its prior.

    Attributes:
        lens: at the mean of the prior, where all values are zero.
        parameters: (k,) names: ``focal`` [of the logarithm of both focal lengths], ``aspect`` [of
            the logarithm of fx / fy], ``centre_x`` and ``centre_y`` [px], distortion coefficients
            as in ``COEFFICIENT_NUMBERS``, and ``offset`` and ``readout`` [s] of the clock.
        sigmas: (k,) their standard deviations.
        clock: at the mean of the prior.

    Raises:
        ValueError: if the kind of lens has no such parameter.
    """

    lens: Lens
    parameters: tuple[str, ...]
    sigmas: tuple[float, ...]
    clock: Clock = Clock()

    def __post_init__(self) -> None:
        known = [FOCAL, ASPECT, CENTRE_X, CENTRE_Y, *COEFFICIENT_NUMBERS[self.lens.kind]]
        known = [] if self.lens.kind == EQUIRECTANGULAR else known
        unknown = [name for name in self.parameters if name not in (*known, *CLOCK)]
        if unknown:
            raise ValueError(f"this lens has no free {', '.join(unknown)}")

    def __len__(self) -> int:
        return len(self.parameters)

    def at(self, values: Array) -> Lens:
        """The lens of (k,) values."""
        steps = self._steps(values)
        if steps.keys() <= {*CLOCK}:
            return self.lens
        packed, half = self.lens.packed.copy(), 0.5 * steps.get(ASPECT, 0.0)
        packed[:2] *= np.exp(steps.get(FOCAL, 0.0) + np.array([half, -half]))
        packed[2:4] += steps.get(CENTRE_X, 0.0), steps.get(CENTRE_Y, 0.0)
        for name, number in COEFFICIENT_NUMBERS[self.lens.kind].items():
            packed[4 + number] += steps.get(name, 0.0)
        make, size = _MAKERS[self.lens.kind]
        named = dict(zip(("fx", "fy", "cx", "cy"), packed.tolist(), strict=False))
        return make(**named, distortion=packed[4 : 4 + size].tolist())

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

    def coefficient(self, name: str, values: Array) -> float:
        """A distortion coefficient of the lens of (k,) values."""
        return float(self.at(values).packed[4 + COEFFICIENT_NUMBERS[self.lens.kind][name]])

    def fill_columns(self, lens: Lens, points_camera_m: Array, columns: Array) -> None:
        """Derivatives of the pixels of some points by the values of the lens.

        Args:
            lens: at the values.
            points_camera_m: (n, 3).
            columns: (k, 2, n), filled; zero where a point is not projectable, and of the clock,
                which :meth:`fill_clock_columns` fills.
        """
        pixels, projectable = lens.project(points_camera_m)
        off_centre = np.empty((2, len(pixels)))
        np.subtract(pixels.T, lens.packed[2:4, None], out=off_centre)
        fields = {
            FOCAL: off_centre,
            ASPECT: off_centre,
            CENTRE_X: np.array([[1.0], [0.0]]),
            CENTRE_Y: np.array([[0.0], [1.0]]),
            **dict.fromkeys(CLOCK, np.zeros((1, 1))),
        }
        plane, squared = _on_plane(lens, np.ascontiguousarray(points_camera_m.T))
        for row, (name, sigma) in enumerate(zip(self.parameters, self.sigmas, strict=True)):
            field, unit = fields.get(name), np.array([[sigma], [sigma]])
            if field is None:
                field, unit = (
                    _by_coefficient(lens, name, plane, squared),
                    unit * lens.packed[:2, None],
                )
            np.multiply(field, unit * [[0.5], [-0.5]] if name == ASPECT else unit, out=columns[row])
        if not projectable.all():
            columns[:, :, ~projectable] = 0.0

    def fill_clock_columns(self, by_time: Array, rows_px: Array, columns: Array) -> None:
        """Derivatives by the values of the clock.

        Args:
            by_time: (2, n) derivatives of the pixels by the time when they are taken.
            rows_px: (n,) of the pixels.
            columns: (k, 2, n), those of the clock are filled.
        """
        shares: dict[str, float | Array] = {OFFSET: 1.0, READOUT: self.clock.shares(rows_px)}
        for row, (name, sigma) in enumerate(zip(self.parameters, self.sigmas, strict=True)):
            if name in CLOCK:
                columns[row] = by_time * (sigma * shares[name])


def time_derivative(T_camera_lidar: Array, by_pose: Array, twists_per_s: Array) -> Array:
    """(2, n) derivatives of pixels by the time: a camera that waits moves by the LiDAR's twist.

    Args:
        T_camera_lidar: (4, 4).
        by_pose: (6, 2, n) derivatives in the tangent of T_lidar_camera.
        twists_per_s: (n, 6) of the LiDAR.
    """
    twists = twists_per_s @ gtsam.Pose3(T_camera_lidar).AdjointMap().T
    return np.asarray((by_pose * twists.T[:, None]).sum(axis=0))


def _on_plane(lens: Lens, points: Array) -> tuple[Array, Array]:
    """(2, n) undistorted points; (n,) radius squared, of a fisheye the squared field angle."""
    x, y, z = points
    if lens.kind == FISHEYE:
        radius = np.hypot(x, y)
        theta = np.arctan2(radius, z)
        return points[:2] * (theta / np.maximum(radius, np.finfo(float).tiny)), theta**2
    depth = z + lens.packed[4] * np.sqrt(x**2 + y**2 + z**2) if lens.kind == OMNIDIRECTIONAL else z
    with np.errstate(divide="ignore", invalid="ignore"):  # of points that are not projectable
        plane = points[:2] / depth
    if not np.isfinite(plane).all():
        plane[~np.isfinite(plane)] = 0.0
    return plane, plane[0] * plane[0] + plane[1] * plane[1]


def _by_coefficient(lens: Lens, name: str, plane: Array, squared: Array) -> Array:
    """(2, n) derivative of the distorted points by a coefficient."""
    a, b = plane
    if name == "p1":
        return np.stack([2 * a * b, squared + 2 * b**2])
    if name == "p2":
        return np.stack([squared + 2 * a**2, 2 * a * b])
    power = squared ** int(name[1])
    if lens.kind == PINHOLE and (rational := lens.packed[9:12]).any():
        k4, k5, k6 = rational
        power /= 1.0 + squared * (k4 + squared * (k5 + squared * k6))
    return np.asarray(plane * power)


@dataclass(frozen=True, eq=False)
class FreeLensBlock:
    """The correspondences of one camera whose lens has free parameters.

    Attributes:
        block: with its loss; its own lens takes no part. Without its motion, the clock is not
            observable.
        lens: of the camera.
    """

    block: ProjectionBlock
    lens: FreeLens

    def columns(self, T_camera_lidar: Array, values: Array) -> Array:
        """(6 + k + 1, 2, n) derivatives of the whitened residuals, and last the residuals.

        In GTSAM's tangent of T_lidar_camera, and by the lens.

        Args:
            T_camera_lidar: (4, 4).
            values: (k,) of the lens.
        """
        block, lens = self.block, self.lens.at(values)
        columns = np.empty((7 + len(self.lens), 2, len(block)))
        points = self._points_lidar_m(values)
        pixels = lens.fill_twist_columns(T_camera_lidar, points, columns[:6])
        columns[:6] *= -1.0  # T_lidar_camera exp(xi) is exp(-xi) T_camera_lidar
        points = points @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3]
        self.lens.fill_columns(lens, points, columns[6:-1])
        self._fill_clock_columns(T_camera_lidar, columns)
        columns[-1] = lens.subtract(pixels.T, block.pixels_px).T
        whiten(columns, block.sqrt_information)
        return np.asarray(columns / block.sigma)

    def _points_lidar_m(self, values: Array) -> Array:
        """(n, 3) where the points are when their pixels are taken."""
        block = self.block
        if block.motion is None:
            return block.points_lidar_m
        times_s = self.lens.clock_at(values).times_s(block.pixels_px[:, 1])
        return displace(block.points_lidar_m, block.motion[:, :6], block.motion[:, 6] - times_s)

    def _fill_clock_columns(self, T_camera_lidar: Array, columns: Array) -> None:
        """Derivatives by the clock: a camera that waits has moved by the twist of the LiDAR."""
        motion = self.block.motion
        if motion is not None and {*CLOCK} & {*self.lens.parameters}:
            by_time = time_derivative(T_camera_lidar, columns[:6], motion[:, :6])
            self.lens.fill_clock_columns(by_time, self.block.pixels_px[:, 1], columns[6:-1])

    def loss(self, columns: Array) -> tuple[Array, Array]:
        """(n,) robust loss of the residuals of some columns, and its weight."""
        squares = np.square(columns[-1]).sum(axis=0)
        return losses_and_weights(loss_id(self.block.loss), self.block.scale, squares)

    def sums(self, T_camera_lidar: Array, values: Array) -> BlockSums:
        """H (6 + k, 6 + k), b and c of the whole block."""
        columns = self.columns(T_camera_lidar, values)
        loss, weight = self.loss(columns)
        flat = columns.reshape(len(columns), -1)
        products = (flat[:-1] * np.tile(weight, 2)) @ flat.T
        return BlockSums(products[:, :-1], products[:, -1], np.asarray(loss.sum()))

    def select(self, rows: NDArray[np.int64]) -> FreeLensBlock:
        """The block with only some correspondences."""
        return FreeLensBlock(self.block.select(rows), self.lens)


def free_lens_factor(keys: Sequence[int], block: FreeLensBlock) -> gtsam.CustomFactor:
    """The block as one factor on ``T_lidar_camera`` and the lens, equal to its separate factors.

    Args:
        keys: of the pose and of the lens, a vector of k numbers; a pose ``T_lidar_cloud`` before
            these displaces the points.
        block: of the camera.
    """

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        *clouds, pose = (values.atPose3(key) for key in keys[:-1])
        seen = clouds[0].between(pose) if clouds else pose
        sums = block.sums(seen.inverse().matrix(), values.atVector(keys[-1]))
        found, jacobian = square_root(sums)
        by_pose = jacobian[:, :6]
        by_cloud = [-by_pose @ seen.inverse().AdjointMap()] if clouds else []
        return found, [*by_cloud, by_pose, jacobian[:, 6:]]

    return custom_factor(gtsam.noiseModel.Unit.Create(7 + len(block.lens)), keys, linearize)
