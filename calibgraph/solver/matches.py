"""One camera's correspondences, ready for the graph, and their residuals at an extrinsic."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.calibration import Residuals
from calibgraph.model.clock import at_pixels, motion_of
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Camera, Rig
from calibgraph.solver.robust import (
    IDENTITY,
    MIN_SIGMA_PX,
    ResidualScale,
    constrained_root,
    error_gradient,
    median_norm,
    quantile,
    quantiles,
    robust_spread,
    scale_from,
    sqrt_information,
)
from factors import ProjectionBlock

MIN_MATCHES = 6
"""Of fewer correspondences a pose (three determine it) leaves too few residuals to check it by."""

_MAX_SAMPLE = 5000  # correspondences for a choice of candidates: a mean loss is known to 1 or 2 %
_GATE_BAND = 0.1  # relative half width of the band about the gate whose density is measured


@dataclass(frozen=True, eq=False)
class CameraBlock:
    """One camera's correspondences, ready for the graph.

    Attributes:
        block: whitened by their weights and information; its scale is left at the default.
        information: (n, 3) or None: as given, without weights, for errors in pixels.
        frame: (n,) sorted frame numbers.
    """

    block: ProjectionBlock
    information: Array | None
    frame: NDArray[np.int64]

    @cached_property
    def frame_edges(self) -> NDArray[np.int64]:
        """(f + 1,) where the frames begin, and the end."""
        frame, count = self.frame, len(self.frame)
        if not count or frame[0] == frame[-1]:
            return np.arange(0, count + 1, max(count, 1))
        new = (frame[1:] != frame[:-1]).nonzero()[0] + 1
        return np.concatenate([[0], new, [count]])

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def frame_numbers(self) -> NDArray[np.int64]:
        """(f,) of the frames that they come from."""
        return self.frame[self.frame_edges[:-1]]

    @property
    def frames(self) -> int:
        """How many frames they come from."""
        return len(self.frame_edges) - 1

    @property
    def frame_counts(self) -> NDArray[np.int64]:
        """(f,) of the correspondences of each frame."""
        return self.frame_edges[1:] - self.frame_edges[:-1]

    def sorted_by(self, of_frame: NDArray[np.int64]) -> CameraBlock:
        """The same correspondences in the order of a number of their frames, (f,)."""
        return self.select(np.argsort(np.repeat(of_frame, self.frame_counts), kind="stable"))

    def select_evenly(self, most: int) -> CameraBlock:
        """Every k-th correspondence, so that at most so many are left."""
        step = -(-len(self.frame) // most)
        return self if step <= 1 else self.select(np.arange(0, len(self.frame), step))

    def with_weights(self, weights: Array) -> CameraBlock:
        """The same correspondences, their information times (n,) weights."""
        root = self.block.sqrt_information
        columns = np.zeros((3, len(weights))) if root is None else root.T * np.sqrt(weights)
        if root is None:
            columns[0] = columns[2] = np.sqrt(weights)
        return replace(self, block=self.block.rewhiten(columns.T))

    def with_scale(self, scale: ResidualScale) -> ProjectionBlock:
        """The projection block with its loss, in units of the residuals' sigma."""
        return self.block.rescale(scale=scale.loss_scale / scale.sigma, sigma=scale.sigma)

    def select(self, rows: NDArray[Any]) -> CameraBlock:
        """Some rows: a mask or an index array."""
        if rows.dtype == np.bool_:
            rows = rows.nonzero()[0]
            if len(rows) == len(self.frame):
                return self
        information = None if self.information is None else self.information[rows]
        return CameraBlock(self.block.select(rows), information, self.frame[rows])

    def all_sizes(
        self, T_camera_lidar: Array, runs: NDArray[np.int64] | None = None
    ) -> tuple[Array, Array]:
        """Norms of the residuals over the median of a standard Gaussian's.

        The median of Gaussian ones of one standard deviation per axis is that standard deviation.
        Sizes of all matches at one pose are kept: scale, gate and checks ask for them in turn.

        Args:
            T_camera_lidar: (1, 4, 4), or (r, 4, 4) with one of each run.
            runs: (r, 2) of all correspondences, see ``ProjectionBlock.residuals``.

        Returns:
            (n,) unweighted errors [px]; (n,) whitened errors; infinite where a point is not
            projectable.
        """
        place, last = T_camera_lidar.tobytes(), self.__dict__.get("_last_sizes")
        if runs is not None or last is None or last[0] != place:
            last = place, self._sizes(T_camera_lidar, runs)
        if runs is None:  # in one step: no thread sees sizes of another pose
            self.__dict__["_last_sizes"] = last
        return last[1]

    def _sizes(self, T_camera_lidar: Array, runs: NDArray[np.int64] | None) -> tuple[Array, Array]:
        medians = median_norm(self.information)
        if self.information is None:
            norms = self.block.run_norms(T_camera_lidar, runs) / medians
            return (sizes := norms[0]), sizes if len(norms) == 1 else norms[1]
        sizes_px = self._constrained.run_norms(T_camera_lidar, runs)[-1] / medians
        return sizes_px, self.block.run_norms(T_camera_lidar, runs)[-1] / medians

    @cached_property
    def _constrained(self) -> ProjectionBlock:
        """Whitened so that the norms are errors along the directions that matches constrain [px].

        The plain reprojection error where no information is given; for an edge, the distance.
        """
        given = self.information
        return self.block.rewhiten(None if given is None else constrained_root(given))

    def without_outliers(self, T_camera_lidar: Array, scale: ResidualScale) -> CameraBlock:
        """The inliers (paper, two-pass solver, step 2): within the gate, and projectable."""
        return self.select(self.within_gate(T_camera_lidar, scale.gate_px))

    def within_gate(self, T_camera_lidar: Array, gate_px: float) -> NDArray[np.bool_]:
        """(n,) which are projectable, with an error of at most so many pixels."""
        sizes_px = self.all_sizes(T_camera_lidar[None])[0]
        return np.asarray(sizes_px <= gate_px / median_norm(self.information))

    def gate_hessian(self, T_camera_lidar: Array, scale: ResidualScale) -> Array:
        """(6, 6) what the gate's moving with the extrinsic adds to the Hessian of the inliers.

        A step of the extrinsic takes matches over the edge of the gate, out on one side and in on
        the other, and their gradients with them. The term is some percent of the Hessian, and
        negative. It is measured on the matches near the edge, on both sides of it.
        """
        T, medians = T_camera_lidar[None], median_norm(self.information)
        errors, whitened = (sizes * medians for sizes in self.all_sizes(T))
        near = np.abs(errors - scale.gate_px) < _GATE_BAND * scale.gate_px
        edge = self.select(near)
        across = error_gradient(edge.block.residuals(T)[0], errors[near], edge.information)
        across *= (whitened[near] / errors[near])[:, None]
        root = np.column_stack([across, np.zeros(len(across))])
        weighted = replace(edge, block=edge.block.rewhiten(root)).with_scale(scale)
        return np.asarray(-weighted.summarize(T).hessian[0] / (2 * _GATE_BAND))

    def summary(self, T_camera_lidar: Array, scale: ResidualScale) -> Residuals:
        """What a result reports of the residuals at its extrinsic."""
        sizes_px = self.all_sizes(T_camera_lidar[None])[0]
        return Residuals(
            median_px=quantile(sizes_px * median_norm(self.information), 0.5),
            inlier_share=float(np.mean(self.within_gate(T_camera_lidar, scale.gate_px))),
            sigma_px=robust_spread(sizes_px),
            loss_scale_px=scale.loss_scale,
            gate_px=scale.gate_px,
        )

    def best_candidate(self, candidates: Sequence[Array], scale_px: float) -> int:
        """Which of some T_camera_lidar has the least mean Cauchy loss, over an even selection."""
        if len(candidates) == 1:
            return 0
        errors = self.select_evenly(_MAX_SAMPLE)._constrained.rescale(scale=scale_px)
        return int(np.argmin(errors.costs_at_each(np.array(candidates))))

    def scale(self, T_camera_lidar: Array, config: Config) -> ResidualScale:
        """The configured scales, or those of the residuals' own spread at a T_camera_lidar."""
        return self.scale_of(*self.all_sizes(T_camera_lidar[None]), config)

    def scale_of(self, sizes_px: Array, sizes: Array, config: Config) -> ResidualScale:
        """The same of residuals by :meth:`all_sizes`."""
        if config.loss_scale_px is not None and config.gate_px is not None:
            unmeasured = math.nan if np.isfinite(sizes_px).any() else math.inf
            return ResidualScale(1.0, config.loss_scale_px, config.gate_px, unmeasured)
        spread_px = robust_spread(sizes_px)
        spread = spread_px if sizes is sizes_px else robust_spread(sizes)
        return scale_from(spread_px, max(spread, self.least_spread), config)

    @cached_property
    def least_spread(self) -> float:
        """MIN_SIGMA_PX as a whitened residual."""
        return float(self.least_spreads(np.array([[0, len(self)]]))[0])

    def least_spreads(self, runs: NDArray[np.int64]) -> Array:
        """(r,) MIN_SIGMA_PX as a whitened residual, in each of (r, 2) runs."""
        root = self.block.sqrt_information
        if root is None:
            return np.full(len(runs), MIN_SIGMA_PX)
        sizes = np.sqrt(root[:, 0] ** 2 + root[:, 2] ** 2)
        return np.asarray(MIN_SIGMA_PX * quantiles(sizes, runs, 0.5))


def merge(parts: Sequence[CameraBlock]) -> CameraBlock:
    """The correspondences of one camera's frames under each other, in the order given."""
    block = ProjectionBlock.join([part.block for part in parts])
    frame = np.concatenate([part.frame for part in parts])
    if all(part.information is None for part in parts):
        return CameraBlock(block, None, frame)
    information = [
        np.tile(IDENTITY, (len(part.frame), 1)) if part.information is None else part.information
        for part in parts
    ]
    return CameraBlock(block, np.concatenate(information), frame)


def camera_blocks(rig: Rig, table: Correspondences, config: Config) -> dict[str, CameraBlock]:
    """The preprocessed correspondences of every camera that has enough to be solved from."""
    cameras = rig.cameras.items()
    blocks = {name: camera_block(camera, table.of_camera(name), config) for name, camera in cameras}
    return {name: block for name, block in blocks.items() if len(block) >= MIN_MATCHES}


def camera_block(camera: Camera, rows: Correspondences, config: Config) -> CameraBlock:
    """The preprocessed correspondences of one camera, their points at the times of the pixels."""
    root, motion = sqrt_information(rows, config), motion_of(camera, rows)
    points = at_pixels(camera, rows).points_lidar_m
    block = ProjectionBlock(camera.lens, points, rows.pixels_px, root, motion=motion)
    return CameraBlock(block, rows.information_px, rows.frame)
