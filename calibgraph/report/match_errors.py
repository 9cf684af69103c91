"""Reprojection errors of one camera's correspondences, as the diagrams show them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array


@dataclass(frozen=True, eq=False)
class ReprojectionErrors:
    """The errors of one camera's preprocessed correspondences at one extrinsic.

    Attributes:
        points_lidar_m: (n, 3) in the LiDAR frame.
        pixels_px: (n, 2) matched pixels.
        projected_px: (n, 2) projections of the points.
        vectors_px: (n, 2) projected less matched, along the directions that the match constrains:
            for an edge, across it. The gate compares its length.
        distances_m: (n,) from the camera to the points.
        frame: (n,) frame numbers.
        gate_px: tau of the result.
    """

    points_lidar_m: Array
    pixels_px: Array
    projected_px: Array
    vectors_px: Array
    distances_m: Array
    frame: NDArray[np.int64]
    gate_px: float

    @property
    def sizes_px(self) -> Array:
        """(n,) lengths of ``vectors_px``."""
        return np.asarray(np.hypot(*self.vectors_px.T))

    @property
    def is_inlier(self) -> NDArray[np.bool_]:
        """(n,) whether the error is within the gate."""
        return np.asarray(self.sizes_px <= self.gate_px)

    def select(self, rows: NDArray[np.bool_]) -> ReprojectionErrors:
        """The errors of some correspondences."""
        columns: dict[str, Any] = {
            name: column[rows]
            for name, column in vars(self).items()
            if isinstance(column, np.ndarray)
        }
        return replace(self, **columns)


@dataclass(frozen=True, eq=False)
class BeforeAfter:
    """The errors of the same correspondences at the guess and at the result."""

    before: ReprojectionErrors
    after: ReprojectionErrors
