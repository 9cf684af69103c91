"""How picked points lie in space: whether they are on one line or in one plane."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Shape = Literal["line", "plane", "space"]

FLAT_M = 0.06
"""Root mean square distance from a line or plane up to which points lie on it: ranges have 2 to
3 cm of noise, so that two planes nearer than that are one."""


def shape_of(points_m: Array) -> tuple[Shape, float]:
    """Whether (n, 3) points lie on a line, in a plane, or neither, and how far off it [m], rms."""
    centred = points_m - points_m.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(points_m))
    spread = np.pad(spread, (0, 3 - len(spread)))
    off_line = float(np.hypot(spread[1], spread[2]))
    if off_line <= FLAT_M:
        return "line", off_line
    return ("plane" if spread[2] <= FLAT_M else "space"), float(spread[2])
