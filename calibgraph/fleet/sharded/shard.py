"""One file of a table, which stays where it was read; what leaves it are sums and selections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.fleet.sharded.quantiles import Counts, count_bins, values_in_bin
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import BlockResiduals, CameraBlock
from calibgraph.solver.frame_fits import FrameFits, fit_alone
from calibgraph.solver.grid import frame_edges
from calibgraph.solver.pnp import frame_pose
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.repeats import point_hashes
from calibgraph.solver.residual_scale import ResidualScale
from calibgraph.solver.stage1 import frames_from
from calibgraph.solver.whitening import sqrt_information
from factors import ProjectionBlock, to_runs

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The frames of one camera in a file, after preprocessing.

    Attributes:
        numbers: (f,) of the frames.
        counts: (f,) their correspondences.
        contents: (f,) equal for frames of equal content.
        informed: whether pixels have information; None without a row.
    """

    numbers: Numbers
    counts: Numbers
    contents: NDArray[np.uint64]
    informed: bool | None


@dataclass(frozen=True, eq=False)
class Inventory:
    """What a file holds.

    Attributes:
        cameras: per camera of the rig.
        counts: per camera, how many are left after each filter.
        repeated: per camera, frames that repeat another one of the file.
        metadata: of the table.
    """

    cameras: dict[str, CameraFrames]
    counts: dict[str, dict[str, int]]
    repeated: dict[str, int]
    metadata: dict[str, Any]


class Shard:
    """One file: its correspondences, before and after the gate, and values that were measured."""

    def __init__(self, rig: Rig, path: str, config: Config) -> None:
        kept = preprocess(rig, Path(path), config)
        self._rig, self._config, self._kept = rig, config, kept
        self._rows = {name: kept.table.of_camera(name) for name in rig.cameras}
        self._blocks: dict[tuple[str, str], CameraBlock] = {}
        self._confidence: dict[str, Array] = {}
        self._fits: dict[str, FrameFits] = {}
        self._values: dict[str, Array] = {}

    def inventory(self) -> Inventory:
        """What the file holds."""
        cameras = {name: _frames_of(rows) for name, rows in self._rows.items()}
        kept = self._kept
        return Inventory(cameras, kept.counts, kept.repeated_frames, kept.table.metadata)

    def drop(self, camera: str, numbers: Numbers) -> None:
        """Leave out frames of a camera: those that repeat a frame of another file."""
        rows = self._rows[camera]
        self._rows[camera] = rows.select(~np.isin(rows.frame, numbers))

    def rows_at(self, camera: str, places: Numbers) -> Correspondences:
        """Some preprocessed rows of a camera."""
        return self._rows[camera].select(places)

    def frame_rows(self, numbers: Numbers) -> Correspondences:
        """The preprocessed rows of some frames, of all cameras."""
        table = self._kept.table
        return table.select(np.isin(table.frame, numbers))

    def are_all_found(self, camera: str, start: Array | None) -> bool:
        """Whether a pose near all frames of a camera leads to one of each, see ``frames_from``."""
        frames = frames_from(start, self._rig.cameras[camera], self._rows[camera], self._config)
        return bool(frames.found.all())

    def stage1(self, camera: str, start: Array | None) -> tuple[Array, Numbers]:
        """(f, 4, 4) T_camera_lidar of the frames that PnP solves; (f,) their numbers."""
        rows, model = self._rows[camera], self._rig.cameras[camera]
        frames = frames_from(start, model, rows, self._config)
        left = np.flatnonzero(~frames.found).tolist()
        own = {i: frame_pose(model, frames.rows_of(i), self._config) for i in left}
        return frames.with_poses(own).solved

    def build(self, cameras: Sequence[str]) -> None:
        """The blocks of the cameras that have enough; the rows are given up."""
        self._kept = replace(self._kept, table=self._kept.table.select(slice(0, 0)))
        for name in cameras:
            rows = self._rows[name]
            block = ProjectionBlock(
                self._rig.cameras[name].lens,
                rows.points_lidar_m,
                rows.pixels_px,
                sqrt_information(rows, self._config),
                self._config.loss,
            )
            self._blocks["all", name] = CameraBlock(block, rows.information_px, rows.frame)
            self._confidence[name] = rows.confidence.astype(np.float64)
        self._rows = {}

    def block_at(self, stage: str, camera: str, places: Numbers) -> CameraBlock:
        """Some correspondences."""
        return self._blocks[stage, camera].select(places)

    def sums(self, stage: str, camera: str, T: Array, scale: float, sigma: float) -> Array:
        """(28,) the upper triangle of H, b and c at a (4, 4) T_lidar_camera."""
        block = self._blocks[stage, camera].block.rescale(scale=scale, sigma=sigma)
        sums = block.sums(gtsam.Pose3(T))
        return np.concatenate([sums.hessian[_UPPER], sums.gradient, [sums.cost]])

    def run_sums(  # noqa: PLR0913, PLR0917
        self, stage: str, camera: str, T: Array, scale: float, sigma: float, run: Numbers
    ) -> Array:
        """(r, 28) of each run of frames at its own of (r, 4, 4) T_camera_lidar; (f,) their runs."""
        own = self._blocks[stage, camera]
        block = own.block.rescale(scale=scale, sigma=sigma)
        sums, total = block.run_sums(T[run], to_runs(own.frame_edges)), np.zeros((len(T), 28))
        np.add.at(total[:, :21], run, sums.hessian[:, _UPPER[0], _UPPER[1]])
        np.add.at(total[:, 21:27], run, sums.gradient)
        np.add.at(total[:, 27], run, sums.cost)
        return total

    def gradients(self, stage: str, camera: str, T: Array, scale: float, sigma: float) -> Array:
        """(p, 6) b at each of (p, 4, 4) T_camera_lidar."""
        block = self._blocks[stage, camera].block.rescale(scale=scale, sigma=sigma)
        return block.gradients_at_each(T)

    def frame_gradients(self, stage: str, camera: str, T: Array, scale: ResidualScale) -> Array:
        """(f, 6) of each frame at a (4, 4) T_lidar_camera."""
        return self._blocks[stage, camera].frame_gradients(gtsam.Pose3(T), scale)

    def gate(self, camera: str, T_camera_lidar: Array, scale: ResidualScale) -> tuple[Numbers, ...]:
        """Keep the inliers; (f,) numbers and (f,) counts of the frames that have some."""
        inliers = self._blocks["all", camera].without_outliers(T_camera_lidar, scale)
        self._blocks["inliers", camera] = inliers
        return inliers.frame_numbers, np.diff(inliers.frame_edges)

    def gate_hessian(self, camera: str, T_camera_lidar: Array, scale: ResidualScale) -> Array:
        """(6, 6) what the gate's moving adds to the Hessian."""
        return self._blocks["all", camera].gate_hessian(T_camera_lidar, scale)

    def fit_frames(self, camera: str, starts: Array) -> FrameFits:
        """Every frame fitted alone; the sizes of the residuals stay here."""
        self._fits[camera] = fit_alone(self._blocks["all", camera], starts)
        return replace(self._fits[camera], sizes=np.empty(0))

    def weigh(
        self, camera: str, weights: Array, middles: Array, falling: Array, median: float
    ) -> tuple[Numbers, ...]:
        """Weigh frames and confidences; numbers and counts of the frames that are left.

        Args:
            camera: whose.
            weights: (f,) of the frames.
            middles: (g,) confidences, with none if all weigh the same.
            falling: (g,) logarithms of the standard deviations there.
            median: what standard deviations are divided by.
        """
        block, confidence = self._blocks["all", camera], self._confidence.pop(camera)
        sigmas = np.ones(len(confidence))
        if len(middles):
            sigmas = np.exp(np.interp(confidence, middles, falling)) / median
        each = np.repeat(weights, np.diff(block.frame_edges))
        counted = each > 0
        kept = block.select(counted).with_weights(each[counted] / sigmas[counted] ** 2)
        self._blocks["all", camera] = kept
        for values in (self._fits, self._values):
            values.clear()
        return kept.frame_numbers, np.diff(kept.frame_edges)

    def measure(self, what: str, camera: str, *arguments: Any) -> Counts:
        """Compute a value per correspondence, keep them here, and count them by bins."""
        values: Array = getattr(self, f"_{what}")(camera, *arguments)
        self._values[what] = values
        return count_bins(values)

    def values_in_bin(self, what: str, number: int) -> Array:
        """The values of one bin, of those that were measured last."""
        return values_in_bin(self._values[what], number)

    def _sizes_px(self, camera: str, T_camera_lidar: Array) -> Array:
        block = self._blocks["all", camera]
        unweighted, whitened = block.all_sizes(T_camera_lidar[None])
        self._values["sizes"] = whitened
        return unweighted

    def _sizes(self, camera: str) -> Array:
        """The whitened ones of the sizes that were measured last."""
        return self._values["sizes"]

    def _least(self, camera: str) -> Array:
        root = self._blocks["all", camera].block.sqrt_information
        if root is None:
            return np.empty(0)
        return np.asarray(np.sqrt(root[:, 0] ** 2 + root[:, 2] ** 2))

    def _residuals(self, camera: str, T_camera_lidar: Array) -> BlockResiduals:
        return self._blocks["all", camera].at(T_camera_lidar)

    def _errors_px(self, camera: str, T_camera_lidar: Array) -> Array:
        return self._residuals(camera, T_camera_lidar).errors_px

    def count_inliers(self, camera: str, T_camera_lidar: Array, scale: ResidualScale) -> int:
        """How many are within the gate."""
        return int(self._residuals(camera, T_camera_lidar).inliers(scale).sum())

    def any_projectable(self, camera: str, T_camera_lidar: Array) -> bool:
        """Whether any correspondence is in front of the camera."""
        return bool(self._residuals(camera, T_camera_lidar).projectable.any())

    def scale_sizes(self, camera: str, spreads: Array) -> None:
        """Divide the sizes of the fitted frames by (f,) spreads."""
        fits = self._fits[camera]
        each = np.repeat(spreads, fits.counts.astype(np.int64))
        self._fits[camera] = replace(fits, spreads=spreads, sizes=fits.sizes / each)

    def _confident(self, camera: str) -> Array:
        """The confidences of the correspondences whose residual is known."""
        return self._confidence[camera][np.isfinite(self._fits[camera].sizes)]

    def ties(self, camera: str, bounds: Array) -> Numbers:
        """(b,) how many of these confidences are equal to each bound."""
        values = self._confident(camera)
        return np.array([np.count_nonzero(values == bound) for bound in bounds], dtype=np.int64)

    def group(self, camera: str, bounds: Array, below: Numbers) -> None:
        """Divide the correspondences with a residual into groups of rising confidence.

        Args:
            camera: whose.
            bounds: (g - 1,) the largest confidence of each group but the last.
            below: (g - 1,) how many of those that are equal to it, in order, are of the group.
        """
        values = self._confident(camera)
        number = np.zeros(len(values), dtype=np.int64)
        for bound, inside in zip(bounds, below, strict=True):
            equal = np.flatnonzero(values == bound)
            number += values > bound
            number[equal[inside:]] += 1
        self._values["group"] = number.astype(np.float64)

    def _size_of_group(self, camera: str, group: int) -> Array:
        sizes = self._fits[camera].sizes
        return np.asarray(sizes[np.isfinite(sizes)][self._values["group"] == group])

    def _confidence_of_group(self, camera: str, group: int) -> Array:
        return np.asarray(self._confident(camera)[self._values["group"] == group])

    def _learnt(self, camera: str, middles: Array, falling: Array) -> Array:
        return np.asarray(np.exp(np.interp(self._confidence[camera], middles, falling)))


def _frames_of(rows: Correspondences) -> CameraFrames:
    edges = frame_edges(rows.camera_index, rows.frame)
    informed = None if not len(rows) else rows.information_px is not None
    if not len(rows):
        none = np.empty(0, np.int64)
        return CameraFrames(none, none, none.astype(np.uint64), informed)
    contents = np.add.reduceat(point_hashes(rows.points_lidar_m), edges[:-1])
    return CameraFrames(rows.frame[edges[:-1]], np.diff(edges), contents, informed)
