"""One camera's correspondences ready for the graph, and how large their residuals are."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

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
_HALF = 0.5
_CUT = 4.0  # medians: inliers lie below, in one and in two dimensions
_GATE_BAND = 0.1  # of the gate, on either side of it
_JUDGED = 5000  # matches, to tell which pose explains them
_IDENTITY = np.array([1.0, 0.0, 1.0])  # entries (0,0), (0,1), (1,1)
_MEDIAN_NORM = np.array([0.67449, 1.17741])  # of a standard Gaussian error in 1 and 2 dimensions


@dataclass(frozen=True)
class Scale:
    """How large the residuals of one camera are taken to be.

    Attributes:
        sigma: what whitened residuals are divided by, so that they have unit variance: 1 with a
            fixed loss scale (the paper's objective), else their robust spread.
        loss_scale: delta, of the whitened residual before that division.
        gate_px: tau.
        sigma_px: robust spread of the unweighted residuals, per axis; infinite if there are none;
            NaN if it was not measured, because loss and gate are configured.
    """

    sigma: float
    loss_scale: float
    gate_px: float
    sigma_px: float

    def narrowed(self, factor: float) -> Scale:
        """With a smaller loss: so many times the sigma and the loss's scale."""
        return replace(self, sigma=factor * self.sigma, loss_scale=factor * self.loss_scale)


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

    @cached_property
    def frame_edges(self) -> NDArray[np.int64]:
        """(f + 1,) where the frames begin, and the end."""
        new = np.flatnonzero(np.diff(self.frame)) + 1
        return np.concatenate([[0], new, [len(self.frame)]])

    def weighted(self, weights: Array) -> Matches:
        """The matches with their information times (n,) weights."""
        root = self.block.sqrt_information
        ones = np.tile(_IDENTITY, (len(self.frame), 1)) if root is None else root
        root = ones * np.sqrt(weights)[:, None]
        return replace(self, block=replace(self.block, sqrt_information=root))

    def select(self, rows: NDArray[Any]) -> Matches:
        """Only some rows."""
        information = None if self.information is None else self.information[rows]
        return Matches(self.block.select(rows), information, self.frame[rows])

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

    def scaled(self, scale: Scale) -> ProjectionBlock:
        """The block with its loss, in units of the residuals' sigma."""
        return self.block.rescaled(scale=scale.loss_scale / scale.sigma, sigma=scale.sigma)

    def errors_px(self, T_camera_lidar: Array) -> tuple[Array, NDArray[np.bool_]]:
        """(n,) unweighted errors [px] where constrained; (n,) whether projectable."""
        residuals, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
        return constrained_error_px(residuals, self.information), valid

    def best_explained_by(self, candidates: Sequence[Array], scale_px: float) -> int:
        """Which of some T_camera_lidar has the least mean Cauchy loss, over an even selection."""
        every = -(-len(self.frame) // _JUDGED)
        judged = self.select(np.arange(0, len(self.frame), every))
        errors = [judged.errors_px(T)[0] / scale_px for T in candidates]
        return int(np.argmin([np.mean(np.log1p(e**2)) for e in errors]))

    def scale(self, T_camera_lidar: Array, config: Config) -> Scale:
        """The configured scales, or those of the residuals' own spread at a pose."""
        if config.loss_scale_px is not None and config.gate_px is not None:
            _, valid = self.block.residuals(to_T_lidar_camera(T_camera_lidar))
            unmeasured = math.nan if valid.any() else math.inf
            return Scale(1.0, config.loss_scale_px, config.gate_px, unmeasured)
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

    def gated(self, T_camera_lidar: Array, scale: Scale) -> Matches:
        """Without what lies beyond the gate, or behind the camera (paper, two-pass solver, 2)."""
        errors, valid = self.errors_px(T_camera_lidar)
        return self.select(valid & (errors <= scale.gate_px))

    def gate_hessian(self, T_camera_lidar: Array, scale: Scale) -> Array:
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
        edge = replace(self.block.select(band), sqrt_information=root).rescaled(
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

    def summary(self, T_camera_lidar: Array, scale: Scale) -> Residuals:
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


def scale_from(sigma_px: float, spread: float, config: Config) -> Scale:
    """The configured scales, or those of the residuals' spread.

    Args:
        sigma_px: robust spread of the unweighted residuals.
        spread: robust spread of the whitened residuals.
        config: may fix either scale.
    """
    fixed = config.loss_scale_px
    return Scale(
        sigma=spread if fixed is None else 1.0,
        loss_scale=CAUCHY_SCALE_SIGMAS * spread if fixed is None else fixed,
        gate_px=config.gate_px or GATE_SIGMAS * max(sigma_px, MIN_SIGMA_PX),
        sigma_px=sigma_px,
    )


def merged(parts: Sequence[Matches]) -> Matches:
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
    return Matches(block, information, np.concatenate([part.frame for part in parts]))


def robust_spread(values: Array) -> float:
    """The median of the values that belong together, among others that may be the majority.

    Starts from a low quantile and takes the median of what lies within _CUT of it until it stands
    still: clean values give their median; a broad background, up to three quarters of all, hardly
    moves it; and values without a core give a large spread, since their median then grows.
    """
    if not len(values):
        return math.inf
    ordered = np.sort(values)

    def quantile_below(limit: float, share: float) -> float:
        last = int(np.searchsorted(ordered, limit, side="right")) - 1
        if last < 0:
            return math.nan
        place = share * last
        low = int(place)
        below, above = ordered[low], ordered[min(low + 1, last)]
        return float(below + (place - low) * (above - below))

    return settled_spread(quantile_below)


def settled_spread(quantile_below: Callable[[float, float], float]) -> float:
    """The iteration of :func:`robust_spread`.

    Args:
        quantile_below: quantile, of a given share, of the values up to a limit; NaN without any.
    """
    spread = _START_FACTOR * quantile_below(math.inf, _START_QUANTILE)
    for _ in range(100):
        before, spread = spread, quantile_below(_CUT * spread, _HALF)
        if math.isnan(spread):
            return before
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
