"""Score grids with known peaks."""

from __future__ import annotations

import numpy as np

from calibgraph.matching.structure.shift_scores import ShiftScores


def make_grids(peaks: np.ndarray, reach: int = 12, sigma: float = 2.0) -> np.ndarray:
    """(g, s, s) score grids with one Gaussian peak each, at the shifts (u, v) of (g, 2)."""
    axis = np.arange(-reach, reach + 1)
    u, v = np.meshgrid(axis, axis)
    squares = (u - peaks[:, 0, None, None]) ** 2 + (v - peaks[:, 1, None, None]) ** 2
    grids = np.exp(-0.5 * squares / sigma**2)
    return (grids - grids.mean(axis=(1, 2), keepdims=True)).astype(np.float32)


def make_scores(twist: np.ndarray, *, outlier_share: float, seed: int = 0) -> ShiftScores:
    """Groups whose peaks a twist explains, and further unknowns, but for a share of outliers."""
    rng = np.random.default_rng(seed)
    units = np.append([200, 200, 200, 40, 40, 40], np.full(len(twist) - 6, 4))
    jacobian = rng.uniform(-1, 1, (300, 2, len(twist))) * units
    shifts = jacobian @ twist
    outlier = rng.random(300) < outlier_share
    shifts[outlier] = rng.uniform(-12, 12, (np.count_nonzero(outlier), 2))
    zeros = np.zeros((300, 3))
    return ShiftScores(
        grids=make_grids(shifts),
        jacobian=jacobian,
        points_lidar_m=zeros,
        pixels_px=zeros[:, :2],
        frame=np.zeros(300, np.int64),
        weights=np.full(300, 10.0),
        steps_per_px=np.ones(2),
    )
