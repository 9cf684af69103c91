"""One camera's correspondences ready for the graph, and how large their residuals are."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Residuals
from calibgraph.config import Config
from calibgraph.correspondences import Correspondences
from calibgraph.graph import to_T_lidar_camera
from calibgraph.preprocess import constrained_error_px, sqrt_information
from calibgraph.rig import Rig
from factors import ProjectionBlock

Array = NDArray[np.float64]

MIN_MATCHES = 6
"""Fewer correspondences than this do not determine a pose with anything to check it by."""

CAUCHY_SCALE_SIGMAS = 2.385
"""Robust scale in standard deviations: 95 % efficiency on Gaussian noise with Cauchy's loss."""

GATE_SIGMAS = 3.035
"""Gate in standard deviations: 99 % of two-dimensional Gaussian errors lie inside."""

MIN_SIGMA_PX = 0.05
"""Spread below which `auto` does not shrink: noise-free data would have none."""

_START_QUANTILE, _START_FACTOR = 0.2, 1.762  # that quantile of a Rayleigh law, to its median
_CUT = 4.0  # medians: inliers lie below, in one and in two dimensions
_MEDIAN_NORM = np.array([0.67449, 1.17741])  # of a standard Gaussian error in 1 and 2 dimensions


@dataclass(frozen=True)
class Scale:
    """How large the residuals of one camera are taken to be.

    Attributes:
        sigma: what whitened residuals are divided by, so that they have unit variance: 1 with a
            fixed loss scale (the paper's objective), else their robust spread.
        loss_scale: delta, of the whitened residual before that division.
        gate_px: tau.
        sigma_px: robust spread of the unweighted residuals, per axis.
    """

    sigma: float
    loss_scale: float
    gate_px: float
    sigma_px: float


@dataclass(frozen=True, eq=False)
class Matches:
    """One camera's correspondences, ready for the graph.

    Attributes:
        block: whitened by their weights and information; its scale is left at the default.
        information: (n, 3) or None: as given, for judging errors in pixels.
        frame: (n,) sorted frame numbers.
    """

    block: ProjectionBlock
    information: Array | None
    frame: NDArray[np.int64]

    def select(self, rows: NDArray[np.bool_]) -> Matches:
        """Only some rows."""
        kept = [None if a is None else a[rows]
                for a in (self.block.sqrt_information, self.information)]  # fmt: skip
        block = replace(
            self.block,
            points_lidar_m=self.block.points_lidar_m[rows],
            pixels_px=self.block.pixels_px[rows],
            sqrt_information=kept[0],
        )
        return Matches(block, kept[1], self.frame[rows])

    def scaled(self, scale: Scale) -> ProjectionBlock:
        """The block with its loss, in units of the residuals' sigma."""
        root = self.block.sqrt_information
        if scale.sigma != 1.0:
            ones = np.tile([1.0, 0.0, 1.0], (len(self.frame), 1))
            root = (ones if root is None else root) / scale.sigma
        return replace(self.block, sqrt_information=root, scale=scale.loss_scale / scale.sigma)

    def errors_px(self, T_camera_lidar: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(n,) unweighted errors [px] where constrained; (n,) whether projectable."""
        residuals, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
        return constrained_error_px(residuals, self.information), valid

    def scale(self, T_camera_lidar: Array, config: Config) -> Scale:
        """The configured scales, or those of the residuals' own spread at a pose."""
        residuals, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
        sigma_px = self._spread(constrained_error_px(residuals, self.information)[valid], valid)
        spread = max(self._spread(self._whitened_norm(residuals)[valid], valid), self._floor)
        fixed = config.loss_scale_px
        return Scale(
            sigma=spread if fixed is None else 1.0,
            loss_scale=CAUCHY_SCALE_SIGMAS * spread if fixed is None else fixed,
            gate_px=config.gate_px or GATE_SIGMAS * max(sigma_px, MIN_SIGMA_PX),
            sigma_px=sigma_px,
        )

    def gated(self, T_camera_lidar: Array, scale: Scale) -> Matches:
        """Without what lies beyond the gate, or behind the camera (paper, two-pass solver, 2)."""
        errors, valid = self.errors_px(T_camera_lidar)
        return self.select(valid & (errors <= scale.gate_px))

    def summary(self, T_camera_lidar: Array, scale: Scale) -> Residuals:
        """The residuals of all these correspondences at a pose."""
        errors, valid = self.errors_px(T_camera_lidar)
        return Residuals(
            median_px=float(np.median(errors)),
            inlier_share=float(np.mean(valid & (errors <= scale.gate_px))),
            sigma_px=self._spread(errors[valid], valid),
            loss_scale_px=scale.loss_scale,
            gate_px=scale.gate_px,
        )

    def _whitened_norm(self, residuals: Array) -> Array:
        root = self.block.sqrt_information
        if root is None:
            return np.hypot(residuals[:, 0], residuals[:, 1])
        first = root[:, 0] * residuals[:, 0] + root[:, 1] * residuals[:, 1]
        return np.hypot(first, root[:, 2] * residuals[:, 1])

    @cached_property
    def _floor(self) -> float:
        """MIN_SIGMA_PX as a whitened residual."""
        root = self.block.sqrt_information
        typical = 1.0 if root is None else float(np.median(np.hypot(root[:, 0], root[:, 2])))
        return MIN_SIGMA_PX * typical

    @cached_property
    def _constrained_axes(self) -> NDArray[np.int64]:
        """(n,) how many directions each match constrains: 1 or 2."""
        if self.information is None:
            return np.full(len(self.frame), 2)
        uu, uv, vv = self.information.T
        rank_one = uu * vv - uv**2 <= 1e-3 * (uu + vv) ** 2
        return np.where(rank_one, 1, 2)

    def _spread(self, norms: Array, valid: NDArray[np.bool_]) -> float:
        """Robust standard deviation per axis from error norms; infinite without any."""
        if not len(norms):
            return math.inf
        return robust_spread(norms / _MEDIAN_NORM[self._constrained_axes[valid] - 1])


def robust_spread(values: Array) -> float:
    """The median of the values that belong together, among others that may be the majority.

    Starts from a low quantile and takes the median of what lies within _CUT of it until it stands
    still: clean values give their median; a broad background, up to three quarters of all, hardly
    moves it; and values without a core give a large spread, since their median then grows.
    """
    spread = _START_FACTOR * float(np.quantile(values, _START_QUANTILE))
    for _ in range(100):
        core = values[values <= _CUT * spread]
        if not len(core):
            break
        before, spread = spread, float(np.median(core))
        if abs(spread - before) <= 1e-6 * before:
            break
    return spread


def matches_by_camera(rig: Rig, table: Correspondences, config: Config) -> dict[str, Matches]:
    """The preprocessed correspondences of every camera that has enough to be solved from."""
    matches = {}
    for name, camera in rig.cameras.items():
        rows = table.of_camera(name)
        if len(rows) >= MIN_MATCHES:
            root = sqrt_information(rows, config)
            block = ProjectionBlock(
                camera.lens, rows.points_lidar_m, rows.pixels_px, root, config.loss
            )
            matches[name] = Matches(block, rows.information_px, rows.frame)
    return matches
