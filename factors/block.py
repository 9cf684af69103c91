"""Thousands of robust projection factors of one camera as one 7-row factor, without approximation.

For correspondences k with whitened residual r_k, Jacobian J_k, s_k = |r_k|^2 and robust loss rho,

    H = sum psi_k J_k^T J_k     b = sum psi_k J_k^T r_k     c = sum rho(s_k),   psi_k = rho'(s_k).

A factor with Jacobian A = [M; 0] (7 x 6), M^T M = H, and error e = [M^-T b; sqrt(c - |M^-T b|^2)]
has A^T A = H, A^T e = b and |e|^2 = c: the linearization and the error are those of the separate
robust factors. The root is real, since |M^-T b|^2 <= sum psi_k s_k <= sum rho(s_k) for every loss
that is concave in s with rho(0) = 0. With k further columns, M has 6 + k columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.arrays import (
    BlockSums,
    RobustBlock,
    check_shape,
    contiguous,
    join_roots,
    read_only,
    rows_of_root,
    to_runs,
)
from factors.columns import CLOCK, Columns, displace
from factors.kernel import (
    COLUMNS,
    COST,
    CURVATURE,
    NO_FREE,
    NO_STEP,
    NORMS,
    PRODUCTS,
    RESIDUALS,
    pass_over,
)
from factors.lens import Lens
from factors.pose import cauchy_noise, custom_factor, lossless_factor

Array = NDArray[np.float64]

_WIDTHS = {"points_lidar_m": 3, "pixels_px": 2, "sqrt_information": 3, "motion": 7}


@dataclass(frozen=True, eq=False)
class ProjectionBlock(RobustBlock):
    """Correspondences of one camera, as a structure of arrays. Immutable: its arrays are read-only.

    Attributes:
        lens: the camera's lens.
        points_lidar_m: (n, 3) points in the LiDAR frame.
        pixels_px: (n, 2) observed pixels.
        sqrt_information: (n, 3) entries (0,0), (0,1), (1,1) of upper triangular whitening matrices
            [1/px], or None for the identity.
        scale: norm of a whitened residual, divided by sigma, at which Cauchy's loss bends (the
            paper's delta); infinite for the residuals' squares.
        sigma: divides all whitened residuals.
        motion: (n, 7) or None: the twist of the LiDAR, rotation [rad/s] and translation [m/s], and
            how long after its scan the points are where they are here [s].

    Raises:
        ValueError: on wrong shapes, values that are not finite, a scale or sigma <= 0.
    """

    lens: Lens
    points_lidar_m: Array
    pixels_px: Array
    sqrt_information: Array | None = None
    scale: float = 4.0
    sigma: float = 1.0
    motion: Array | None = None
    _columns: Array = field(init=False, repr=False)  # (5, n) x y z u v, or (12, n) with the motion
    _whitening: Array = field(init=False, repr=False)  # (3, n), (1, n) or (0, n), see the kernel
    _whole: NDArray[np.int64] = field(init=False, repr=False)  # (1, 2) the run of all

    def __post_init__(self) -> None:
        n = len(self.points_lidar_m)
        for name, width in _WIDTHS.items():
            if getattr(self, name) is not None:
                check_shape(name, getattr(self, name), (n, width))
        self._check_scales()
        columns = np.empty((5 if self.motion is None else 12, n))
        columns[:3], columns[3:5] = self.points_lidar_m.T, self.pixels_px.T
        if self.motion is not None:
            columns[5:] = self.motion.T
        self._initialize(columns, *rows_of_root(self.sqrt_information))

    def _initialize(self, columns: Array, root: Array | None, rows: int) -> None:
        """Set the arrays of a block that is being made: held once, as columns, and read-only."""
        columns, root = read_only(columns), root if root is None else read_only(root)
        self.__dict__.update(
            _columns=columns,
            _whitening=columns[:0] if root is None else root[:rows],
            _whole=to_runs(np.array([0, columns.shape[1]])),
            points_lidar_m=columns[:3].T,
            pixels_px=columns[3:5].T,
            motion=columns[5:].T if len(columns) > 5 else None,  # noqa: PLR2004
            sqrt_information=None if root is None else root.T,
        )

    def __len__(self) -> int:
        return len(self.pixels_px)

    def rewhiten(self, sqrt_information: Array | None) -> ProjectionBlock:
        """The same correspondences, not copied, with other (n, 3) whitening matrices, or none."""
        if sqrt_information is not None:
            check_shape("sqrt_information", sqrt_information, (len(self), 3))
        other = self._copy()
        other._initialize(self._columns, *rows_of_root(sqrt_information))
        return other

    def select(self, rows: NDArray[Any]) -> ProjectionBlock:
        """The block with only some correspondences: a mask or an index array."""
        if rows.dtype == np.bool_:
            rows = rows.nonzero()[0]
            if len(rows) == len(self):
                return self
        root, other = self.sqrt_information, self._copy()
        other._initialize(
            self._columns.take(rows, axis=1),
            None if root is None else root.T.take(rows, axis=1),
            len(self._whitening),
        )
        return other

    @staticmethod
    def join(parts: Sequence[ProjectionBlock]) -> ProjectionBlock:
        """The correspondences of blocks of one lens under each other; scale as of the first."""
        roots = join_roots([part.sqrt_information for part in parts], [*map(len, parts)])
        joined, columns = parts[0]._copy(), np.concatenate([p._columns for p in parts], axis=1)
        joined._initialize(columns, *rows_of_root(roots))
        return joined

    def sums(self, T_lidar_camera: gtsam.Pose3) -> BlockSums:
        """H, b and c of the whole block at a pose, in one pass over the data."""
        return self.summarize(contiguous(T_lidar_camera.inverse().matrix())[None]).first()

    def costs_at_each(self, T_camera_lidar: Array) -> Array:
        """(p,) c of the whole block at each of (p, 4, 4) poses."""
        runs = self._whole.repeat(len(T_camera_lidar), axis=0)
        sums = np.zeros((len(runs), 1, 8, 7))
        self._pass_over(T_camera_lidar, COST, sums, runs=runs)
        return sums[:, 0, 7, 0]

    def summarize(
        self,
        T_camera_lidar: Array,
        runs: NDArray[np.int64] | None = None,
        free: Columns | None = None,
        values: Array | None = None,
        *,
        scales: Array | None = None,
        step: Array = NO_STEP,
        curvature: bool = False,
    ) -> BlockSums:
        """H, b and c of each run by pose and further columns, stacked, and sums of the weights.

        Args:
            T_camera_lidar: (r, 4, 4) of each run, or (1, 4, 4).
            runs: (r, 2) its first correspondence, and the one behind its last; None: one run.
            free: k columns beside the pose; their lens is the block's, too. Without a motion, a
                clock is not observable.
            values: (k,) of these; None: zeros.
            scales: (r,) of the loss in each run, in place of ``scale``.
            step: (6 + k,) of pose and columns: the residuals are those after so much of it, to
                first order.
            curvature: whether the second derivative of half the cost is wanted, too.
        """
        runs, size = self._whole if runs is None else runs, 6 + (0 if free is None else len(free))
        sums = np.zeros((len(runs), 2 if curvature else 1, size + 2, size + 1))
        wanted = CURVATURE if curvature else PRODUCTS
        self._pass_over(
            T_camera_lidar, wanted, sums, free, values, runs=runs, scales=scales,
            step=contiguous(step),
        )  # fmt: skip
        return BlockSums.unpack(sums)

    def fit(
        self,
        T_camera_lidar: Array,
        runs: NDArray[np.int64],
        scales: Array | None = None,
        *,
        tolerance: float,
    ) -> tuple[Array, BlockSums, NDArray[np.bool_]]:
        """Minimize the robust cost of each run by itself, by Levenberg-Marquardt.

        Args:
            T_camera_lidar: (r, 4, 4) starts, or (1, 4, 4).
            runs: (r, 2) as above.
            scales: (r,) as above.
            tolerance: relative decrease of the cost at which a run is done.

        Returns:
            (r, 4, 4) minima; the sums there; (r,) which ended by the tolerance.
        """
        sums, moved = np.zeros((len(runs), 1, 8, 7)), np.empty((len(runs), 4, 4))
        moved[:], ended = T_camera_lidar, np.empty(len(runs), np.bool_)
        self._pass_over(
            moved, PRODUCTS, sums, runs=runs, scales=scales, tolerance=tolerance, flags=ended
        )
        return moved, BlockSums.unpack(sums), ended

    def columns(
        self, T_camera_lidar: Array, free: Columns | None = None, values: Array | None = None
    ) -> Array:
        """(6 + k + 1, 2, n) derivatives of the whitened residuals, and last the residuals.

        In GTSAM's tangent of T_lidar_camera, and by further columns.

        Args:
            T_camera_lidar: (4, 4).
            free: k columns beside the pose.
            values: (k,) of these; None: zeros.
        """
        found = np.empty((7 + (0 if free is None else len(free)), 2, len(self)))
        self._pass_over(T_camera_lidar[None], COLUMNS, found, free, values)
        return found

    def residuals(
        self, T_camera_lidar: Array, runs: NDArray[np.int64] | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """(n, 2) unweighted residuals ``pi - u`` [px]; (n,) whether the point is projectable.

        Args:
            T_camera_lidar: (r, 4, 4) of each run, or (1, 4, 4).
            runs: (r, 2) as of the sums, which hold every point once; None: one run.
        """
        residuals, valid = np.empty((len(self), 2)), np.empty(len(self), np.bool_)
        self._pass_over(T_camera_lidar, RESIDUALS, residuals, runs=runs, flags=valid)
        return residuals, valid

    def run_norms(self, T_camera_lidar: Array, runs: NDArray[np.int64] | None = None) -> Array:
        """(2, n) norms of the unweighted [px] and of the whitened residuals.

        One row if there is no whitening; infinite where a point is not projectable. The whitened
        ones are not divided by sigma. Arguments as of :meth:`residuals`.
        """
        norms = np.empty((1 if len(self._whitening) == 0 else 2, len(self)))
        valid = np.empty(len(self), np.bool_)
        self._pass_over(T_camera_lidar, NORMS, norms, runs=runs, flags=valid)
        return norms

    def _pass_over(
        self,
        T_camera_lidar: Array,
        wanted: int,
        out: Array,
        free: Columns | None = None,
        values: Array | None = None,
        *,
        scales: Array | None = None,
        **rest: Any,
    ) -> None:
        lens, columns, packed = self.lens, self._columns, NO_FREE
        if free is not None:
            lens = free.lens if values is None else free.at(values)
            columns = self._columns_at(free, np.zeros(len(free)) if values is None else values)
            moves = free.displacements(columns[:3], columns[4], columns[5:11])
            packed = *free.packed, contiguous(moves)
        scales = NO_STEP if scales is None else contiguous(scales)
        pass_over(
            lens.kind, lens.packed, T_camera_lidar, columns, wanted, out,
            whitening=self._whitening, scale=float(self.scale), scales=scales,
            sigma=float(self.sigma), free=packed, **rest,
        )  # fmt: skip

    def _columns_at(self, free: Columns, values: Array) -> Array:
        """The arrays of the block, with its points where they are when their pixels are taken."""
        if self.motion is None or not {*CLOCK} & {*free.parameters}:
            return self._columns
        late = self.motion[:, 6] - free.clock_at(values).times_s(self.pixels_px[:, 1])
        if not late.any():
            return self._columns
        points = displace(self.points_lidar_m, self.motion[:, :6], late)
        return read_only(np.concatenate([points.T, self._columns[3:]]))


def block_factor(key: int, block: ProjectionBlock) -> gtsam.CustomFactor:
    """The block as one factor on the variable ``T_lidar_camera``, equal to its separate factors."""
    return lossless_factor([key], lambda pose: (block.sums(pose), None))


def fields_px(
    points_lidar_m: Array,
    T_camera_lidar: Array,
    free: Columns,
    twists_per_s: Array | None = None,
) -> tuple[Array, Array]:
    """Project points, with the derivatives of the pixels by a twist of the pose and by columns.

    Args:
        points_lidar_m: (n, 3) where they are when their pixels are taken.
        T_camera_lidar: (4, 4); the twist xi perturbs it as exp(xi) T_camera_lidar.
        free: the lens, and k columns.
        twists_per_s: (6,) or (n, 6) of the LiDAR; of one whose motion is unknown, derivatives by
            the clock are zero.

    Returns:
        (n, 2) pixels; (6 + k, 2, n) derivatives: by rotation [px/rad], translation [px/m], columns.
    """
    pixels, _ = free.lens.project(points_lidar_m @ T_camera_lidar[:3, :3].T + T_camera_lidar[:3, 3])
    motion = None
    if twists_per_s is not None:
        motion = np.empty((len(pixels), 7))
        motion[:, :6], motion[:, 6] = twists_per_s, free.clock.times_s(pixels[:, 1])
    block = ProjectionBlock(free.lens, points_lidar_m, pixels, motion=motion)
    columns = block.columns(T_camera_lidar, free)[:-1]
    columns[:6] *= -1.0  # T_lidar_camera exp(-xi) is exp(xi) T_camera_lidar, inverted
    return pixels, columns


def projection_residual(
    lens: Lens, T_lidar_camera: gtsam.Pose3, point_lidar_m: Array, pixel_px: Array
) -> tuple[Array, Array]:
    """Residual ``pi(T_lidar_camera^-1 p) - u`` and its Jacobian.

    Args:
        lens: the camera's lens.
        T_lidar_camera: pose of the camera in the LiDAR frame.
        point_lidar_m: (3,) point in the LiDAR frame.
        pixel_px: (2,) observed pixel.

    Returns:
        (2,) residual [px]; (2, 6) Jacobian in GTSAM's tangent (rotation, translation) of the pose.
    """
    by_pose = np.zeros((3, 6), order="F")
    point_camera = T_lidar_camera.transformTo(point_lidar_m, by_pose)
    pixels, by_point = lens.project_with_jacobian(point_camera)
    return pixels[0] - pixel_px, by_point[0] @ by_pose


def projection_factor(
    key: int,
    lens: Lens,
    point_lidar_m: ArrayLike,
    pixel_px: ArrayLike,
    *,
    sqrt_information: ArrayLike | None = None,
    scale: float = 4.0,
) -> gtsam.CustomFactor:
    """One correspondence as a robust projection factor on ``T_lidar_camera`` (paper, Eq. 5).

    The method in stock GTSAM terms, and the reference of the block factor in tests: it costs a
    Python call per correspondence.

    Args:
        key: the pose variable.
        lens: the camera's lens.
        point_lidar_m: (3,) point in the LiDAR frame.
        pixel_px: (2,) observed pixel.
        sqrt_information: (2, 2) upper triangular whitening matrix [1/px]; identity if None.
        scale: whitened residual norm at which Cauchy's loss bends (the paper's delta).
    """
    point = np.asarray(point_lidar_m, dtype=np.float64)
    pixel = np.asarray(pixel_px, dtype=np.float64)
    whitening = np.eye(2) if sqrt_information is None else np.asarray(sqrt_information)

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        residual, jacobian = projection_residual(lens, values.atPose3(key), point, pixel)
        return residual, [jacobian]

    base = gtsam.noiseModel.Gaussian.SqrtInformation(whitening)
    return custom_factor(cauchy_noise(base, scale), [key], linearize)
