"""What two cameras both see, ready for the graph: blocks on their relative pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.model.geometry import relative_transform, to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS, GATE_SIGMAS, robust_spread
from factors import (
    EpipolarBlock,
    ProjectionBlock,
    pair_block_factor,
    ray_spreads,
    unproject,
)

Array = NDArray[np.float64]

MIN_PAIR_MATCHES = 12
"""Of fewer matches the residuals' spread, and with it their weight, is not known."""

PIXEL_SIGMA_PX = 0.4
"""Of a SIFT feature; only its ratio to the error of the range matters."""

_MIN_SIGMA = 0.05  # least spread, as of ``MIN_SIGMA_PX``: noise-free data would have none
_MEDIAN_NORM = {1: 0.67449, 2: 1.17741}  # of a standard Gaussian error


@dataclass(frozen=True, eq=False)
class PairTerm:
    """Features of a pair with one kind of residual, a function of T_b_a alone.

    Attributes:
        a: the camera whose frame the points are in, or the first of the epipolar residual.
        b: the camera whose pixels are predicted, or the second.
        block: with points in A's frame, B's lens and pixels; or epipolar.
        frame: (n,) sorted frame numbers.
    """

    a: str
    b: str
    block: ProjectionBlock | EpipolarBlock
    frame: NDArray[np.int64]

    @cached_property
    def frame_edges(self) -> NDArray[np.int64]:
        """(f + 1,) where the frames begin, and the end."""
        new = np.flatnonzero(np.diff(self.frame)) + 1
        return np.concatenate([[0], new, [len(self.frame)]])

    def select(self, rows: NDArray[Any]) -> PairTerm:
        """Some rows: a mask, or an index array in rising order."""
        return replace(self, block=self.block.select(rows), frame=self.frame[rows])

    def with_sigma(self, sigma: float) -> PairTerm:
        """With residuals divided by sigma; the loss bends where it is 95 % efficient."""
        scaled = self.block.rescale(scale=CAUCHY_SCALE_SIGMAS, sigma=sigma)
        return replace(self, block=scaled)

    def errors(self, T_camera_lidar: Mapping[str, Array]) -> Array:
        """(n,) whitened errors over the median of a standard Gaussian's; inf behind camera B."""
        T_a_b = _pose_of_b_in_a(self, T_camera_lidar)
        if isinstance(self.block, EpipolarBlock):
            return np.abs(self.block.residuals(T_a_b)) / _MEDIAN_NORM[1]
        residuals, projectable = self.block.residuals(T_a_b)
        if self.block.sqrt_information is not None:
            s00, s01, s11 = self.block.sqrt_information.T
            x, y = residuals.T
            residuals = np.column_stack([s00 * x + s01 * y, s11 * y])
        return np.where(projectable, np.hypot(*residuals.T) / _MEDIAN_NORM[2], np.inf)

    def sigma(self, T_camera_lidar: Mapping[str, Array]) -> float:
        """Robust spread of the whitened residuals."""
        return max(robust_spread(self.errors(T_camera_lidar)), _MIN_SIGMA)

    def without_outliers(self, T_camera_lidar: Mapping[str, Array], sigma: float) -> PairTerm:
        """The features within the gate: 99 % of Gaussian errors."""
        median = _MEDIAN_NORM[1 if isinstance(self.block, EpipolarBlock) else 2]
        return self.select(self.errors(T_camera_lidar) * median < GATE_SIGMAS * sigma)

    def factor(self, key_a: int, key_b: int) -> gtsam.NonlinearFactor:
        """The features as one lossless factor on ``T_lidar_a`` and ``T_lidar_b``."""
        return pair_block_factor(key_a, key_b, self.block)


def pair_terms(rig: Rig, table: CameraMatches, config: Config) -> tuple[PairTerm, ...]:
    """The terms of all pairs of a table: A's points in B, B's points in A, and epipolar.

    The epipolar residual is that of features without a range in either camera.

    Args:
        rig: lenses; its extrinsics weigh the errors of the ranges.
        table: with ranges.
        config: the loss.
    """
    terms = []
    for a, b in table.pairs():
        rows = table.of_pair(a, b)
        rows = rows.select(np.argsort(rows.frame, kind="stable"))
        for side, (one, two) in enumerate(((a, b), (b, a))):
            terms.append(_projection_term(rig, (one, two), side, rows, config))
        terms.append(_epipolar_term(rig, (a, b), rows, config))
    return tuple(term for term in terms if len(term.frame) >= MIN_PAIR_MATCHES)


def _projection_term(
    rig: Rig, names: tuple[str, str], side: int, rows: CameraMatches, config: Config
) -> PairTerm:
    """The term of the points of one side, predicted in the other camera."""
    rows = rows.select(np.isfinite(rows.ranges_m[:, side]))
    a, b = (rig.cameras[name] for name in names)
    rays = unproject(a.lens, rows.pixels_px[:, side])[0]
    ranges, sigmas = rows.ranges_m[:, side, None], rows.range_sigmas_m[:, side, None]
    T_b_a = relative_transform(b.T_camera_lidar, a.T_camera_lidar)
    R = T_b_a[:3, :3]
    by_point = b.lens.project_with_jacobian((rays * ranges) @ R.T + T_b_a[:3, 3])[1] @ R
    by_pixel = by_point @ (ray_spreads(a.lens, rays) * ranges[:, :, None])
    by_range = (by_point @ rays[:, :, None]) * sigmas[:, :, None]
    pixel = by_pixel @ by_pixel.transpose(0, 2, 1) + np.eye(2)
    covariance = PIXEL_SIGMA_PX**2 * pixel + by_range @ by_range.transpose(0, 2, 1)
    block = ProjectionBlock(
        b.lens, rays * ranges, rows.pixels_px[:, 1 - side], _whitening(covariance), config.loss
    )
    return PairTerm(*names, block, rows.frame)


def _whitening(covariance: Array) -> Array:
    """(n, 3) upper triangular S with S^T S the inverse of (n, 2, 2) covariances."""
    uu, uv, vv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    over = 1.0 / (uu * vv - uv**2)
    s00 = np.sqrt(vv * over)
    return np.column_stack([s00, -uv * over / s00, 1.0 / np.sqrt(vv)])


def _epipolar_term(
    rig: Rig, names: tuple[str, str], rows: CameraMatches, config: Config
) -> PairTerm:
    rows = rows.select(np.isnan(rows.ranges_m).all(axis=1))
    a, b = (rig.cameras[name] for name in names)
    block = EpipolarBlock(a.lens, b.lens, rows.pixels_px[:, 0], rows.pixels_px[:, 1], config.loss)
    return PairTerm(*names, block, rows.frame)


def _pose_of_b_in_a(term: PairTerm, T_camera_lidar: Mapping[str, Array]) -> gtsam.Pose3:
    """T_a_b as a pose."""
    T_b_a = relative_transform(T_camera_lidar[term.b], T_camera_lidar[term.a])
    return to_T_lidar_camera(T_b_a)


def pair_graph(
    cameras: Sequence[str], terms: Sequence[PairTerm], keys: Mapping[str, int]
) -> gtsam.NonlinearFactorGraph:
    """One lossless block factor per term whose cameras are among the variables."""
    graph = gtsam.NonlinearFactorGraph()
    for term in terms:
        if term.a in cameras and term.b in cameras:
            graph.add(term.factor(keys[term.a], keys[term.b]))
    return graph
