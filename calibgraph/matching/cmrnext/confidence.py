"""Confidence of single matches, 0 to 1.

With an uncertainty head it follows the predicted standard deviations. Without one it is a product
of three factors in 0..1: convergence, correlation peak, and agreement with the frame's pose. It
ranks matches, but is not calibrated: it is no probability.
"""

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.cmrnext.correlation import WINDOW

STEP_PX = 1.0
"""A last iteration that moves the match by this halves its confidence."""

RESIDUAL_PX = 4.0
"""A reprojection error of this at the frame's pose halves it."""

MIN_CONFIDENCE = 1e-3


def from_flow(step_px: Array, peak: Array) -> NDArray[np.float32]:
    """Confidence without an uncertainty head, before the frame's pose is estimated.

    Args:
        step_px: (n,) length of the last iteration's change.
        peak: (n,) softmax share of the correlation at the target among its 9 x 9 neighbours; a
            share no better than chance halves the confidence.

    Returns:
        (n,) in (0, 1]; uncalibrated.
    """
    converged = 1.0 / (1.0 + (step_px / STEP_PX) ** 2)
    distinct = peak / (peak + 1.0 / WINDOW**2)
    return _bound(converged * distinct)


def lower_by_residuals(confidence: NDArray[np.float32], residual_px: Array) -> NDArray[np.float32]:
    """Confidence lowered by (n,) reprojection errors at the pose of the frame's own matches."""
    return _bound(confidence / (1.0 + (residual_px / RESIDUAL_PX) ** 2))


def from_sigmas(sigma_px: Array) -> NDArray[np.float32]:
    """Confidence from (n, 2) predicted standard deviations; 1 for the least, 1 px per axis."""
    return _bound(2.0 / sigma_px.sum(axis=1))


def to_information(sigma_px: Array) -> Array:
    """(n, 3) i_uu, i_uv, i_vv from (n, 2) predicted standard deviations."""
    return np.column_stack(
        [sigma_px[:, 0] ** -2.0, np.zeros(len(sigma_px)), sigma_px[:, 1] ** -2.0]
    )


def _bound(values: Array | NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.nan_to_num(values).clip(MIN_CONFIDENCE, 1.0), dtype=np.float32)
