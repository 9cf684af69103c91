"""One camera's correspondences on many workers, with what the solve asks of ``CameraBlock``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.fleet.sharded.quantiles import SpreadValues
from calibgraph.fleet.sharded.workers import Workers
from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Config
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_block import CameraBlock, merge
from calibgraph.solver.residual_scale import MIN_SIGMA_PX, ResidualScale, scale_from
from factors.block_sums import BlockSums, square_root, unpack_sums

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_SAMPLE = 5000  # correspondences for a choice of candidates, as of ``CameraBlock.best_candidate``


def measure(workers: Workers, what: str, camera: str, *arguments: Any) -> SpreadValues:
    """A value of every correspondence of a camera, which stays where it is."""
    counts = workers.call("measure", what, camera, *arguments)
    return SpreadValues(
        np.sum(counts, axis=0),
        lambda number: np.concatenate(workers.call("values_in_bin", what, number)),
    )


@dataclass(frozen=True, eq=False)
class ShardedProjection:
    """The reprojection term of one camera: sums over all files, in their order."""

    workers: Workers
    stage: str
    camera: str
    loss_scale: float
    sigma: float
    run_parts: tuple[Numbers, ...] = ()  # per file, the run of each frame, as `ShardedBlock` has it

    @property
    def scale(self) -> float:
        """As of ``ProjectionBlock``."""
        return self.loss_scale

    def rescale(self, *, scale: float, sigma: float) -> ShardedProjection:
        """As of ``ProjectionBlock``."""
        return replace(self, loss_scale=scale, sigma=sigma)

    def sums(self, T_lidar_camera: gtsam.Pose3) -> BlockSums:
        """H, b and c at a pose: 28 numbers of each file."""
        return unpack_sums(np.sum(self._call("sums", T_lidar_camera.matrix()), axis=0))

    def run_sums(self, T_camera_lidar: Array, runs: Numbers) -> BlockSums:
        """H, b and c of each run at a pose of its own: 28 numbers of each run and file.

        Args:
            T_camera_lidar: (r, 4, 4).
            runs: (r, 2) of the correspondences, those of ``ShardedBlock.sorted_by``.
        """
        given = (self.stage, self.camera, T_camera_lidar, self.loss_scale, self.sigma)
        parts = self.workers.call("run_sums", *given, each=[(part,) for part in self.run_parts])
        return unpack_sums(np.sum(parts, axis=0))

    def error_and_jacobian(self, T_lidar_camera: gtsam.Pose3) -> tuple[Array, Array]:
        """The (7,) error and (7, 6) Jacobian of the block factor."""
        return square_root(self.sums(T_lidar_camera))

    def gradients_at_each(self, T_camera_lidar: Array) -> Array:
        """(p, 6) b at each of (p, 4, 4) poses."""
        return np.asarray(np.sum(self._call("gradients", T_camera_lidar), axis=0))

    def _call(self, method: str, T: Array) -> list[Any]:
        given = (self.stage, self.camera, T, self.loss_scale, self.sigma)
        return self.workers.call(method, *given)


@dataclass(frozen=True, eq=False)
class ShardedBlock:
    """One camera's correspondences.

    Attributes:
        workers: who hold them.
        camera: whose.
        stage: ``all``, or ``inliers`` after the gate.
        frame_parts: per file, the numbers of the camera's frames.
        count_parts: per file, the correspondences of these.
        whitened: whether residuals have weights or information.
        run_parts: per file, the run of each frame, if the correspondences are sorted by one.
    """

    workers: Workers
    camera: str
    stage: str
    frame_parts: tuple[Numbers, ...]
    count_parts: tuple[Numbers, ...]
    whitened: bool
    run_parts: tuple[Numbers, ...] = ()

    def __len__(self) -> int:
        return int(sum(counts.sum() for counts in self.count_parts))

    @property
    def frame_numbers(self) -> Numbers:
        """(f,) of the frames that they come from."""
        return np.concatenate(self.frame_parts)

    @property
    def frames(self) -> int:
        """How many frames they come from."""
        return sum(map(len, self.frame_parts))

    @property
    def frame_counts(self) -> Numbers:
        """(f,) of the correspondences of each frame."""
        return np.concatenate(self.count_parts)

    def with_frames(self, stage: str, parts: Sequence[tuple[Numbers, Numbers]]) -> ShardedBlock:
        """What is left, by numbers and counts of the frames in each file."""
        frames, counts = zip(*parts, strict=True)
        return replace(self, stage=stage, frame_parts=frames, count_parts=counts)

    def with_scale(self, scale: ResidualScale) -> ShardedProjection:
        """The reprojection term with its loss, in units of the residuals' sigma."""
        bend, runs = scale.loss_scale / scale.sigma, self.run_parts
        return ShardedProjection(self.workers, self.stage, self.camera, bend, scale.sigma, runs)

    def sorted_by(self, of_frame: Numbers) -> ShardedBlock:
        """As ``CameraBlock.sorted_by``, for sums by (f,) numbers from 0 on: nothing moves."""
        edges = np.cumsum([len(numbers) for numbers in self.frame_parts])[:-1]
        return replace(self, run_parts=tuple(np.split(of_frame, edges)))

    def scale(self, T_camera_lidar: Array, config: Config) -> ResidualScale:
        """As ``CameraBlock.scale``: exact quantiles over all files."""
        if config.loss_scale_px is not None and config.gate_px is not None:
            seen = self.workers.call("any_projectable", self.camera, T_camera_lidar)
            return ResidualScale(
                1.0, config.loss_scale_px, config.gate_px, math.nan if any(seen) else math.inf
            )
        sizes_px = measure(self.workers, "sizes_px", self.camera, T_camera_lidar)
        spread = spread_px = sizes_px.robust_spread
        if self.whitened:
            spread = measure(self.workers, "sizes", self.camera).robust_spread
        return scale_from(spread_px, max(spread, self.least_spread), config)

    @cached_property
    def least_spread(self) -> float:
        """MIN_SIGMA_PX as a whitened residual."""
        if not self.whitened:
            return MIN_SIGMA_PX
        return MIN_SIGMA_PX * measure(self.workers, "least", self.camera).median

    def without_outliers(self, T_camera_lidar: Array, scale: ResidualScale) -> ShardedBlock:
        """The inliers: within the gate, and projectable."""
        parts = self.workers.call("gate", self.camera, T_camera_lidar, scale)
        return self.with_frames("inliers", parts)

    def gate_hessian(self, T_camera_lidar: Array, scale: ResidualScale) -> Array:
        """As ``BlockResiduals.gate_hessian``."""
        parts = self.workers.call("gate_hessian", self.camera, T_camera_lidar, scale)
        return np.asarray(np.sum(parts, axis=0))

    def frame_gradients(self, T_lidar_camera: gtsam.Pose3, scale: ResidualScale) -> Array:
        """(f, 6) gradient of half the robust cost of each frame."""
        given = (self.stage, self.camera, T_lidar_camera.matrix(), scale)
        return np.concatenate(self.workers.call("frame_gradients", *given))

    def best_candidate(self, candidates: Sequence[Array], scale_px: float) -> int:
        """As ``CameraBlock.best_candidate``, of the same selection."""
        if len(candidates) == 1:
            return 0
        return self.select_evenly(_SAMPLE).best_candidate(candidates, scale_px)

    def select_evenly(self, most: int) -> CameraBlock:
        """Every k-th correspondence, so that at most so many are left, here."""
        places = even_places([int(counts.sum()) for counts in self.count_parts], most)
        each = [(some,) for some in places]
        return merge(self.workers.call("block_at", self.stage, self.camera, each=each))

    def at(self, T_camera_lidar: Array) -> ShardedResiduals:
        """The residuals at a (4, 4) T_camera_lidar."""
        return ShardedResiduals(self, T_camera_lidar)


@dataclass(frozen=True, eq=False)
class ShardedResiduals:
    """The residuals of a camera at one extrinsic."""

    block: ShardedBlock
    T_camera_lidar: Array

    def summary(self, scale: ResidualScale) -> Residuals:
        """What the result reports of them."""
        workers, camera, T = self.block.workers, self.block.camera, self.T_camera_lidar
        return Residuals(
            median_px=measure(workers, "errors_px", camera, T).median,
            inlier_share=sum(workers.call("count_inliers", camera, T, scale)) / len(self.block),
            sigma_px=measure(workers, "sizes_px", camera, T).robust_spread,
            loss_scale_px=scale.loss_scale,
            gate_px=scale.gate_px,
        )

    @property
    def T_lidar_camera(self) -> gtsam.Pose3:
        """Where."""
        return to_T_lidar_camera(self.T_camera_lidar)


def even_places(counts: Sequence[int], most: int) -> list[Numbers]:
    """Per file the places of every k-th row of all, so that at most so many are left."""
    step = max(1, -(-sum(counts) // most))
    firsts = np.cumsum([0, *counts[:-1]])
    return [np.arange(-first % step, count, step, dtype=np.int64)
            for first, count in zip(firsts.tolist(), counts, strict=True)]  # fmt: skip
