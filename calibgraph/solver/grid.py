"""The best match of each cell of the image grid, in one pass over the matches."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from factors.compiled import compiled

_MOST_CELLS = 1 << 20  # 8 MB of places; of more cells, those that are taken are numbered


def best_in_cell(
    rig: Rig,
    table: Correspondences,
    camera: NDArray[np.int64],
    config: Config,
    *,
    among: NDArray[np.bool_] | None = None,
) -> NDArray[np.int64]:
    """The most confident match of each cell of the image grid, per camera and frame.

    Of equally confident ones the first in the table is kept. So the best of two tables, one after
    the other, are the best among the best of each.

    Args:
        rig: for the sizes of the images.
        table: correspondences.
        camera: (n,) index of each match's camera in the rig.
        config: ``grid_columns``, ``grid_rows``.
        among: (n,) which of them take part; None: all.

    Returns:
        (k,) the rows that are kept, sorted by camera and frame.
    """
    sizes = np.array([[c.width_px, c.height_px] for c in rig.cameras.values()], dtype=np.float64)
    shape = np.array([config.grid_columns, config.grid_rows], dtype=np.float64)
    among = np.ones(len(table), dtype=np.bool_) if among is None else among
    cell, cells = np.empty(len(table), np.int64), config.grid_columns * config.grid_rows
    _number_cells(camera, table.pixels_px, sizes, shape, cell)
    if cells > _MOST_CELLS:
        taken, cell = np.unique(cell, return_inverse=True)
        cells = len(taken)
    if _are_sorted(camera, table.frame):
        edges = frame_edges(camera, table.frame)
        return np.flatnonzero(_best_of_runs(edges, cells, cell, table.confidence, among))
    order = np.lexsort((table.frame, camera))
    edges = frame_edges(camera[order], table.frame[order])
    return np.asarray(
        order[_best_of_runs(edges, cells, cell[order], table.confidence[order], among[order])]
    )


def _are_sorted(camera: NDArray[np.int64], frame: NDArray[np.int64]) -> bool:
    same, later = camera[1:] == camera[:-1], camera[1:] > camera[:-1]
    return bool((later | (same & (frame[1:] >= frame[:-1]))).all())


def frame_edges(camera: NDArray[np.integer[Any]], frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """(g + 1,) where the runs of equal camera and frame begin, and the end."""
    if not len(frame):
        return np.zeros(1, dtype=np.int64)
    new = (camera[1:] != camera[:-1]) | (frame[1:] != frame[:-1])
    return np.concatenate([[0], np.flatnonzero(new) + 1, [len(frame)]])


def _best_of_runs(
    edges: NDArray[np.int64],
    cells: int,
    cell: NDArray[np.int64],
    confidence: NDArray[np.floating[Any]],
    among: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """(n,) which rows have the largest confidence, the first of them, of their run and cell."""
    keep = np.zeros(len(cell), dtype=np.bool_)
    _keep_best(edges, np.full(cells, -1), cell, confidence, among, keep)
    return keep


@compiled()
def _number_cells(camera, pixels, sizes, shape, cells):  # type: ignore[no-untyped-def]
    """Fill (n,) the cell that each pixel lies in; pixels outside belong to the edge cells."""
    for i in range(len(camera)):
        which, number = camera[i], np.int64(0)
        for axis in (1, 0):
            place = (pixels[i, axis] + 0.5) / sizes[which, axis] * shape[axis]
            last = shape[axis] - 1.0
            place = place if place > 0.0 else 0.0
            number = number * np.int64(shape[axis]) + np.int64(place if place < last else last)
        cells[i] = number


@compiled()
def _keep_best(edges, best, cell, confidence, among, keep):  # type: ignore[no-untyped-def]
    """Set which rows are kept; ``best``: a place per cell, of the best row so far, -1 at first.

    One of an earlier run counts as none.
    """
    for run in range(len(edges) - 1):
        first = edges[run]
        for row in range(first, edges[run + 1]):
            if not among[row]:
                continue
            other = best[cell[row]]
            taken = other >= first
            if taken and not confidence[row] > confidence[other]:
                continue
            if taken:
                keep[other] = False
            best[cell[row]], keep[row] = row, True
