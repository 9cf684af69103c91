"""How far single matches can be trusted, 0 to 1.

With an uncertainty head it is the network's own word. Without one it is a product of three signs
that a match is right, each in 0..1; it ranks matches, but is no probability: it is not calibrated.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.cmrnext.correlation import WINDOW

Array = NDArray[np.float64]

STEP_PX = 1.0
"""A last iteration that still moves the match by this halves its confidence."""

RESIDUAL_PX = 4.0
"""An error of this against the frame's pose halves it."""

MIN_CONFIDENCE = 1e-3


def from_signs(step_px: Array, peak: Array) -> NDArray[np.float32]:
    """Confidence without an uncertainty head, before the frame's pose is known.

    Args:
        step_px: (n,) length of the last iteration's change.
        peak: (n,) softmax share of the correlation at the target among its 9 x 9 neighbours; a
            share no better than chance halves the confidence.

    Returns:
        (n,) in (0, 1]; uncalibrated.
    """
    converged = 1.0 / (1.0 + (step_px / STEP_PX) ** 2)
    distinct = peak / (peak + 1.0 / WINDOW**2)
    return _bounded(converged * distinct)


def with_consistency(given: NDArray[np.float32], residual_px: Array) -> NDArray[np.float32]:
    """Confidence lowered by (n,) reprojection errors at the pose that the frame's matches give."""
    return _bounded(given / (1.0 + (residual_px / RESIDUAL_PX) ** 2))


def from_sigmas(sigma_px: Array) -> NDArray[np.float32]:
    """Confidence from (n, 2) predicted standard deviations; 1 for the least, 1 px per axis."""
    return _bounded(2.0 / sigma_px.sum(axis=1))


def information(sigma_px: Array) -> Array:
    """(n, 3) i_uu, i_uv, i_vv from (n, 2) predicted standard deviations."""
    return np.column_stack(
        [sigma_px[:, 0] ** -2.0, np.zeros(len(sigma_px)), sigma_px[:, 1] ** -2.0]
    )


def _bounded(values: Array | NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(np.nan_to_num(values).clip(MIN_CONFIDENCE, 1.0), dtype=np.float32)
