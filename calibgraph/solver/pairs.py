"""What two cameras both see, ready for the graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.findings import error_components
from calibgraph.model.geometry import inverse_ranges, to_T_lidar_camera
from calibgraph.model.rig import Rig
from calibgraph.solver.robust import (
    CAUCHY_SCALE_SIGMAS,
    GATE_SIGMAS,
    MEDIAN_NORM,
    MIN_SIGMA_PX,
    robust_spread,
)
from factors import (
    PairBlock,
    pair_block_factor,
    unproject,
)

MIN_PAIR_MATCHES = 12
"""Of fewer matches the residuals' spread, and with it their weight, is not known."""

ENOUGH_SURFACES = 50
"""Features on surfaces from which on a pair has no epipolar term: a spread of 0.3 px then leaves
an error below that of lenses, 0.05 px on KITTI; and that error, which is shared by all features,
epipolar residuals turn into 0.1 to 0.2 deg about the axis across the baseline, with a spread of
only 0.15 px."""


@dataclass(frozen=True, eq=False)
class PairTerm:
    """Features of a pair with one kind of residual.

    Attributes:
        a: the camera whose features have ranges; of an epipolar residual, the first camera.
        b: the camera in which they are predicted; the second.
        block: the features.
        frame: (n,) sorted frame numbers.
    """

    a: str
    b: str
    block: PairBlock
    frame: NDArray[np.int64]

    @property
    def pair(self) -> frozenset[str]:
        """Its cameras."""
        return frozenset((self.a, self.b))

    def select(self, rows: NDArray[Any]) -> PairTerm:
        """Some rows: a mask, or an index array in rising order."""
        return replace(self, block=self.block.select(rows), frame=self.frame[rows])

    def with_sigma(self, sigma_px: float) -> PairTerm:
        """With residuals divided by sigma, and the loss's scale in units of it."""
        return replace(self, block=self.scaled(sigma_px))

    def scaled(self, sigma_px: float) -> PairBlock:
        """The features with this sigma."""
        return self.block.rescale(scale=CAUCHY_SCALE_SIGMAS, sigma=sigma_px)

    def errors_px(self, T_camera_lidar: Mapping[str, Array]) -> Array:
        """(n,) lengths of the residuals; infinite where B cannot see the point."""
        residuals, projectable = self.block.residuals(*self._poses(T_camera_lidar))
        return np.where(projectable, np.hypot(*residuals.T), np.inf)

    def sigma_px(self, T_camera_lidar: Mapping[str, Array]) -> float:
        """Robust spread of the residuals, per axis."""
        spread = robust_spread(self.errors_px(T_camera_lidar) / MEDIAN_NORM[self.block.axes - 1])
        return max(spread, MIN_SIGMA_PX)

    def without_outliers(self, T_camera_lidar: Mapping[str, Array], sigma_px: float) -> PairTerm:
        """The features within the gate."""
        return self.select(self.errors_px(T_camera_lidar) <= GATE_SIGMAS * sigma_px)

    def _poses(self, T_camera_lidar: Mapping[str, Array]) -> tuple[gtsam.Pose3, gtsam.Pose3]:
        return (
            to_T_lidar_camera(T_camera_lidar[self.a]),
            to_T_lidar_camera(T_camera_lidar[self.b]),
        )


def rows_of_pair(cameras: Sequence[str], pair: PairTerm) -> NDArray[np.intp]:
    """(12,) rows of A's pose, then of B's."""
    first = [6 * cameras.index(name) for name in (pair.a, pair.b)]
    return np.add.outer(first, np.arange(6)).ravel()


def usual_excess(terms: Sequence[PairTerm]) -> float:
    """Variance of what the features of a pair determine, over that if they were independent.

    Features of A in B and of B in A are largely the same ones, of one frame.
    """
    numbers = np.concatenate([term.frame for term in terms])
    frames = max(1, len(np.unique(numbers)))
    return 1 + error_components().pair_correlation * max(0.0, len(numbers) / frames - 1)


def pair_terms(rig: Rig, table: CameraMatches) -> tuple[PairTerm, ...]:
    """The terms of all pairs of a table: A's features in B, B's in A, and epipolar.

    The epipolar residual is that of features without a surface in either camera, of pairs that have
    few with one.

    Args:
        rig: lenses, and extrinsics at which surfaces are ahead of a camera.
        table: with surfaces.
    """
    terms = []
    for a, b in table.pairs():
        rows = table.of_pair(a, b)
        rows = rows.select(np.argsort(rows.frame, kind="stable"))
        sides = [
            _term_of_side(rig, names, side, rows) for side, names in enumerate(((a, b), (b, a)))
        ]
        terms += sides
        if sum(len(term.frame) for term in sides) < ENOUGH_SURFACES:
            terms.append(_epipolar_term(rig, (a, b), rows))
    return tuple(term for term in terms if len(term.frame) >= MIN_PAIR_MATCHES)


def tying_pairs(table: CameraMatches | None) -> list[tuple[str, str]]:
    """The pairs with enough features on surfaces to place one camera by the other."""
    if table is None:
        return []
    known = np.isfinite(table.planes_lidar_per_m[:, :, 0]).sum(axis=1)
    return [
        (a, b) for a, b in table.pairs() if known[table.rows_of_pair(a, b)].sum() >= ENOUGH_SURFACES
    ]


def pair_graph(terms: Iterable[PairTerm], keys: Mapping[str, int]) -> gtsam.NonlinearFactorGraph:
    """One lossless block factor per term.

    Args:
        terms: with their sigmas.
        keys: the variable ``T_lidar_camera`` of each camera.
    """
    graph = gtsam.NonlinearFactorGraph()
    for term in terms:
        graph.add(pair_block_factor(keys[term.a], keys[term.b], term.block))
    return graph


def _term_of_side(rig: Rig, names: tuple[str, str], side: int, rows: CameraMatches) -> PairTerm:
    """The features of one side with their surfaces, predicted in the other camera."""
    a, b = (rig.cameras[name] for name in names)
    rows = rows.select(np.isfinite(rows.planes_lidar_per_m[:, side, 0]))
    rays = unproject(a.lens, rows.pixels_px[:, side])[0]
    planes = rows.planes_lidar_per_m[:, side]
    ahead = inverse_ranges(rays, planes, a.T_camera_lidar) > 0
    rows = rows.select(ahead)
    pixels = rows.pixels_px[:, 1 - side]
    block = PairBlock.of_surfaces(b.lens, rays[ahead], planes[ahead], pixels)
    return PairTerm(*names, block, rows.frame)


def _epipolar_term(rig: Rig, names: tuple[str, str], rows: CameraMatches) -> PairTerm:
    rows = rows.select(np.flatnonzero(np.isnan(rows.planes_lidar_per_m[:, :, 0]).all(axis=1)))
    a, b = (rig.cameras[name] for name in names)
    block = PairBlock.epipolar(a.lens, b.lens, rows.pixels_px[:, 0], rows.pixels_px[:, 1])
    return PairTerm(*names, block, rows.frame)
