"""Peaks: each group's own best shift next to the consensus, as one correspondence."""

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.structure.shift_scores import Grids, ShiftScores
from calibgraph.model.correspondences import Correspondences

PEAK_STEPS = 2  # how far from the consensus a group may peak, in grid steps
MIN_QUALITY = 0.05  # as of a level; the confidence's unit
MIN_CURVATURE_RATIO = 0.1  # to the larger curvature; below, a direction is unconstrained (an edge)


_U, _V = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
_TERMS = np.stack([_U**0, _U, _V, _U**2 / 2, _U * _V, _V**2 / 2]).reshape(6, 9).T
QUADRATIC_FIT = np.linalg.pinv(_TERMS)
"""(6, 9) least-squares fit of 1, u, v, u^2/2, u v, v^2/2 to nine values [v, u]."""


def extract_correspondences(
    scores: ShiftScores, unknowns: Array, camera: str, *, min_quality: float = MIN_QUALITY
) -> Correspondences:
    """Make one correspondence of each group that peaks near the consensus.

    The information of a pixel is the curvature of the group's score (of rank one where the group
    is an edge) times the mean score of its windows at the peak, their quality. The confidence is
    twice the quality, and at least twice MIN_QUALITY, which a solve keeps by default.
    """
    shift, hessian, peak = find_local_peaks(scores.grids, scores.jacobian @ unknowns)
    quality = np.maximum(peak / scores.weights, 0.0)  # 0: no peak
    good = quality > min_quality
    scale = scores.steps_per_px
    information = (hessian * np.outer(scale, scale)).reshape(-1, 4)[:, [0, 1, 3]]
    information *= quality[:, None]
    good &= information[:, 0] + information[:, 2] > 0
    return Correspondences.from_arrays(
        camera=camera,
        frame=scores.frame[good],
        pixels_px=(scores.pixels_px + shift / scale)[good],
        points_lidar_m=scores.points_lidar_m[good],
        confidence=np.clip(2 * quality[good], 2 * MIN_QUALITY, 1.0),
        information_px=information[good],
    )


def find_local_peaks(grids: Grids, centre: Array) -> tuple[Array, Array, Array]:
    """Find each grid's peak near a shift, to a fraction of a step by a quadratic fit.

    Args:
        grids: (g, s, s) scores by shift [v, u].
        centre: (g, 2) the shift (u, v) to search about, in steps.

    Returns:
        (g, 2) shift in steps; (g, 2, 2) Hessian of the negative score [1/steps^2]; (g,) the score
        at the peak, -inf where it is no maximum, or too near to the grid's rim.
    """
    reach = (grids.shape[1] - 1) // 2
    limit = reach - PEAK_STEPS - 1
    base = np.clip(np.rint(centre), -limit, limit).astype(np.int64) + reach
    span = np.arange(-PEAK_STEPS, PEAK_STEPS + 1)
    index = np.arange(len(grids))[:, None, None]
    rows, columns = base[:, 1, None, None] + span[:, None], base[:, 0, None, None] + span
    top = grids[index, rows, columns].reshape(len(grids), len(span) ** 2).argmax(axis=1)
    row = base[:, 1] + span[top // len(span)]
    column = base[:, 0] + span[top % len(span)]
    around = np.arange(-1, 2)
    near = grids[index, row[:, None, None] + around[:, None], column[:, None, None] + around]
    offset, hessian = _fit_quadratics(near.astype(np.float64))
    inside = (np.abs(offset).max(axis=1) < 1.5) & (np.abs(centre).max(axis=1) < limit)  # noqa: PLR2004
    shift = np.stack([column, row], axis=1) - reach + np.clip(offset, -1, 1)
    return shift, hessian, np.where(inside, near[:, 1, 1], -np.inf)


def _fit_quadratics(patches: Array) -> tuple[Array, Array]:
    """Fit a quadratic to 3x3 scores (g, 3, 3), [v, u]; unconstrained directions are dropped.

    Returns:
        (g, 2) offset (u, v) of the maximum; (g, 2, 2) Hessian of the negative score.
    """
    fit = patches.reshape(len(patches), 9) @ QUADRATIC_FIT.T
    values, vectors = np.linalg.eigh(-fit[:, [3, 4, 4, 5]].reshape(-1, 2, 2))
    kept = values > np.maximum(MIN_CURVATURE_RATIO * values[:, 1:], 1e-9)
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    along = np.einsum("gji,gj->gi", vectors, fit[:, 1:3]) * inverse
    offset = np.einsum("gij,gj->gi", vectors, along)
    hessian = np.einsum("gij,gj,gkj->gik", vectors, np.where(kept, values, 0.0), vectors)
    return offset, hessian
