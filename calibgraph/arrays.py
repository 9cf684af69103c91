"""Types of arrays, whose shapes, frames and units stand in docstrings; and cells of a grid."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def name_cells(places: NDArray[Any]) -> NDArray[np.int64]:
    """(n,) a number per cell of places (n, k) on a grid of step 1, in the order of the columns."""
    named = np.zeros(len(places), np.int64)
    for column in places.T:  # a tenth of the time of np.unique by rows
        cell = np.floor(column).astype(np.int64)
        cell -= cell.min(initial=np.iinfo(np.int64).max)
        named *= cell.max(initial=0) + 1
        named += cell
    return named
