"""One camera's correspondences ready for the graph, and how large their residuals are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.solver.preprocess import constrained_error_px, sqrt_information
from calibgraph.solver.residual_scale import MIN_SIGMA_PX, ResidualScale, robust_spread, scale_from
from factors import ProjectionBlock

Array = NDArray[np.float64]

MIN_MATCHES = 6
"""Fewer correspondences than this do not determine a pose with anything to check it by."""

_GATE_BAND = 0.1  # of the gate, on either side of it
_JUDGED = 5000  # matches, to tell which pose explains them
_IDENTITY = np.array([1.0, 0.0, 1.0])  # entries (0,0), (0,1), (1,1)
_MEDIAN_NORM = np.array([0.67449, 1.17741])  # of a standard Gaussian error in 1 and 2 dimensions


@dataclass(frozen=True, eq=False)
class CameraBlock:
    """One camera's correspondences, ready for the graph.

    Attributes:
        block: whitened by their weights and information; its scale is left at the default.
        information: (n, 3) or None: as given, for judging errors in pixels.
        frame: (n,) sorted frame numbers.
    """

    block: ProjectionBlock
    information: Array | None
    frame: NDArray[np.int64]

    @cached_property
    def frame_edges(self) -> NDArray[np.int64]:
        """(f + 1,) where the frames begin, and the end."""
        new = np.flatnonzero(np.diff(self.frame)) + 1
        return np.concatenate([[0], new, [len(self.frame)]])

    def weighted(self, weights: Array) -> CameraBlock:
        """The matches with their information times (n,) weights."""
        root = self.block.sqrt_information
        ones = np.tile(_IDENTITY, (len(self.frame), 1)) if root is None else root
        root = ones * np.sqrt(weights)[:, None]
        return replace(self, block=replace(self.block, sqrt_information=root))

    def select(self, rows: NDArray[Any]) -> CameraBlock:
        """Only some rows."""
        information = None if self.information is None else self.information[rows]
        return CameraBlock(self.block.select(rows), information, self.frame[rows])

    def as_table(self, *, camera: str) -> Correspondences:
        """The matches as a table of correspondences, their weights as information."""
        root, information = self.block.sqrt_information, None
        if root is not None:  # upper triangular, [[a, b], [0, c]]
            a, b, c = root.T
            information = np.column_stack([a * a, a * b, b * b + c * c])
        return Correspondences.from_arrays(
            camera=camera,
            frame=self.frame,
            pixels_px=self.block.pixels_px,
            points_lidar_m=self.block.points_lidar_m,
            information_px=information,
        )

    def scaled(self, scale: ResidualScale) -> ProjectionBlock:
        """The block with its loss, in units of the residuals' sigma."""
        return self.block.rescale(scale=scale.loss_scale / scale.sigma, sigma=scale.sigma)

    def errors_px(self, T_camera_lidar: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(n,) unweighted errors [px] where constrained; (n,) whether projectable."""
        residuals, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
        return constrained_error_px(residuals, self.information), valid

    def best_candidate(self, candidates: Sequence[Array], scale_px: float) -> int:
        """Which of some T_camera_lidar has the least mean Cauchy loss, over an even selection."""
        every = -(-len(self.frame) // _JUDGED)
        judged = self.select(np.arange(0, len(self.frame), every))
        errors = [judged.errors_px(T)[0] / scale_px for T in candidates]
        return int(np.argmin([np.mean(np.log1p(e**2)) for e in errors]))

    def scale(self, T_camera_lidar: Array, config: Config) -> ResidualScale:
        """The configured scales, or those of the residuals' own spread at a pose."""
        if config.loss_scale_px is not None and config.gate_px is not None:
            _, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
            unmeasured = math.nan if valid.any() else math.inf
            return ResidualScale(1.0, config.loss_scale_px, config.gate_px, unmeasured)
        sizes_px, sizes = self.sizes(T_camera_lidar)
        spread_px = robust_spread(sizes_px)
        spread = spread_px if sizes is sizes_px else robust_spread(sizes)
        return scale_from(spread_px, max(spread, self.least_spread), config)

    def sizes(self, T_camera_lidar: Array) -> tuple[Array, Array]:
        """How large the residuals of projectable matches are, in medians of a standard Gaussian.

        Returns:
            (m,) unweighted errors [px]; (m,) whitened errors. The median of Gaussian ones of one
            standard deviation per axis is that standard deviation.
        """
        residuals, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
        medians = self._median_norms[valid] if self._median_norms.ndim else self._median_norms
        sizes_px = constrained_error_px(residuals, self.information)[valid] / medians
        if self.information is None and self.block.sqrt_information is None:
            return sizes_px, sizes_px
        return sizes_px, self._whitened_norm(residuals)[valid] / medians

    def without_outliers(self, T_camera_lidar: Array, scale: ResidualScale) -> CameraBlock:
        """Without what lies beyond the gate, or behind the camera (paper, two-pass solver, 2)."""
        errors, valid = self.errors_px(T_camera_lidar)
        return self.select(valid & (errors <= scale.gate_px))

    def gate_hessian(self, T_camera_lidar: Array, scale: ResidualScale) -> Array:
        """(6, 6) what the gate's moving with the pose adds to the Hessian of the gated matches.

        A step of the pose takes matches over the edge of the gate, out on one side and in on the
        other, and their pull with them. It is some percent of the Hessian, and negative. Known
        from the matches near the edge, so this must be called before they are gated.
        """
        pose = to_T_lidar_camera(T_camera_lidar)
        residuals, valid = self.block.residuals(pose)
        errors = constrained_error_px(residuals, self.information)
        band = valid & (np.abs(errors - scale.gate_px) < _GATE_BAND * scale.gate_px)
        across = self._error_gradient(residuals, errors)[band]
        across *= (self._whitened_norm(residuals)[band] / errors[band])[:, None]
        root = np.column_stack([across, np.zeros(len(across))])
        edge = replace(self.block.select(band), sqrt_information=root).rescale(
            scale=scale.loss_scale / scale.sigma, sigma=scale.sigma
        )
        added: Array = -edge.sums(pose).hessian / (2 * _GATE_BAND)
        return added

    def _error_gradient(self, residuals: Array, errors: Array) -> Array:
        """(n, 2) derivative of the error [px] by the residual."""
        safe = np.maximum(errors, np.finfo(float).tiny)[:, None]
        if self.information is None:
            return np.asarray(residuals / safe)
        uu, uv, vv = self.information.T
        largest = (uu + vv) / 2 + np.hypot((uu - vv) / 2, uv)
        x, y = residuals.T
        pulled = np.column_stack([uu * x + uv * y, uv * x + vv * y])
        return np.asarray(pulled / (largest[:, None] * safe))

    def summary(self, T_camera_lidar: Array, scale: ResidualScale) -> Residuals:
        """The residuals of all these correspondences at a pose."""
        errors, valid = self.errors_px(T_camera_lidar)
        return Residuals(
            median_px=float(np.median(errors)),
            inlier_share=float(np.mean(valid & (errors <= scale.gate_px))),
            sigma_px=robust_spread(self.sizes(T_camera_lidar)[0]),
            loss_scale_px=scale.loss_scale,
            gate_px=scale.gate_px,
        )

    def _whitened_norm(self, residuals: Array) -> Array:
        root = self.block.sqrt_information
        if root is None:
            return constrained_error_px(residuals, None)
        first = root[:, 0] * residuals[:, 0] + root[:, 1] * residuals[:, 1]
        return np.hypot(first, root[:, 2] * residuals[:, 1])

    @cached_property
    def least_spread(self) -> float:
        """MIN_SIGMA_PX as a whitened residual."""
        root = self.block.sqrt_information
        typical = 1.0 if root is None else float(np.median(np.hypot(root[:, 0], root[:, 2])))
        return MIN_SIGMA_PX * typical

    @cached_property
    def _median_norms(self) -> Array:
        """() or (n,) medians of a standard Gaussian error, of as many axes as are constrained."""
        if self.information is None:
            return np.asarray(_MEDIAN_NORM[1])
        uu, uv, vv = self.information.T
        rank_one = uu * vv - uv**2 <= 1e-3 * (uu + vv) ** 2
        return _MEDIAN_NORM[np.where(rank_one, 0, 1)]


def merged(parts: Sequence[CameraBlock]) -> CameraBlock:
    """The matches of one camera's frames under each other, in the order given."""
    first = parts[0].block

    def joined(columns: Sequence[Array | None], ones: Array) -> Array | None:
        if all(column is None for column in columns):
            return None
        filled = [
            np.tile(ones, (len(part.frame), 1)) if column is None else column
            for column, part in zip(columns, parts, strict=True)
        ]
        return np.concatenate(filled)

    block = replace(
        first,
        points_lidar_m=np.concatenate([part.block.points_lidar_m for part in parts]),
        pixels_px=np.concatenate([part.block.pixels_px for part in parts]),
        sqrt_information=joined([p.block.sqrt_information for p in parts], _IDENTITY),
    )
    information = joined([part.information for part in parts], _IDENTITY)
    return CameraBlock(block, information, np.concatenate([part.frame for part in parts]))


def camera_blocks(rig: Rig, table: Correspondences, config: Config) -> dict[str, CameraBlock]:
    """The preprocessed correspondences of every camera that has enough to be solved from."""
    matches = {}
    for name, camera in rig.cameras.items():
        rows = table.of_camera(name)
        if len(rows) >= MIN_MATCHES:
            root = sqrt_information(rows, config)
            block = ProjectionBlock(
                camera.lens, rows.points_lidar_m, rows.pixels_px, root, config.loss
            )
            matches[name] = CameraBlock(block, rows.information_px, rows.frame)
    return matches
