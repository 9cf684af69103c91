"""The best match of each cell of the image grid, in one pass over the matches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from factors.compiled import compiled

Array = NDArray[np.float64]


def best_in_cell(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.bool_]:
    """The most confident match of each cell of the image grid, per camera and frame.

    Of equally confident ones the first in the table is kept. So the best of two tables, one after
    the other, are the best among the best of each.

    Args:
        rig: for the sizes of the images.
        table: correspondences.
        camera: (n,) index of each match's camera in the rig.
        config: ``grid_columns``, ``grid_rows``.

    Returns:
        (n,) which are kept.
    """
    cell = _cells(rig, table.pixels_px, camera, config)
    keep: NDArray[np.bool_] = _best_of_equal_keys(camera, table.frame, cell, table.confidence)
    return keep


def _cells(
    rig: Rig, pixels_px: Array, camera: NDArray[np.int64], config: Config
) -> NDArray[np.int64]:
    """(n,) number of the cell that each pixel lies in; pixels outside belong to the edge cells."""
    sizes = np.array([[c.width_px, c.height_px] for c in rig.cameras.values()], dtype=np.float64)
    shape = np.array([config.grid_columns, config.grid_rows])
    places = np.clip(np.floor((pixels_px + 0.5) / sizes[camera] * shape), 0, shape - 1)
    columns, rows = places.astype(np.int64).T
    return np.asarray(rows * config.grid_columns + columns)


@compiled()
def _best_of_equal_keys(camera, frame, cell, confidence):  # type: ignore[no-untyped-def]
    """(n,) which rows have the largest confidence, the first of them, among those of equal keys.

    A hash table with open addressing, at most half full, holds the best row of every key so far.
    """
    size = 2
    while size < 2 * len(frame):
        size *= 2
    best = np.full(size, -1, dtype=np.int64)
    for row in range(len(frame)):
        mixed = (frame[row] * 1_000_003 + camera[row]) * 10_000_000_019 + cell[row]
        slot = (mixed ^ (mixed >> 29)) & (size - 1)
        other = best[slot]
        while other >= 0 and not (
            frame[other] == frame[row] and camera[other] == camera[row] and cell[other] == cell[row]
        ):
            slot = (slot + 1) & (size - 1)
            other = best[slot]
        if other < 0 or confidence[row] > confidence[other]:
            best[slot] = row
    keep = np.zeros(len(frame), dtype=np.bool_)
    keep[best[best >= 0]] = True
    return keep
