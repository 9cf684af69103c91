"""The best match of each cell of the image grid, in one pass over the matches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from factors.compiled import compiled

Array = NDArray[np.float64]


def best_in_cell(
    rig: Rig,
    table: Correspondences,
    camera: NDArray[np.int64],
    config: Config,
    *,
    among: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
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
        (n,) which are kept.
    """
    sizes = np.array([[c.width_px, c.height_px] for c in rig.cameras.values()], dtype=np.float64)
    shape = np.array([config.grid_columns, config.grid_rows], dtype=np.float64)
    edges, cells_of_run = np.array([0, len(table)]), 0
    if frame_order(camera, table.frame) is None:  # a small hash table each, which stays in cache
        edges = frame_edges(camera, table.frame)
        cells_of_run = config.grid_columns * config.grid_rows
    among = np.ones(len(table), dtype=np.bool_) if among is None else among
    cells = _cells(camera, table.pixels_px, sizes, shape)
    keep: NDArray[np.bool_] = _best_of_equal_keys(
        edges, cells_of_run, camera, table.frame, cells, table.confidence, among
    )
    return keep


def frame_order(camera: NDArray[np.int64], frame: NDArray[np.int64]) -> NDArray[np.int64] | None:
    """(n,) order of rows by camera and frame; None if they are in it already."""
    same, later = camera[1:] == camera[:-1], camera[1:] > camera[:-1]
    if (later | (same & (frame[1:] >= frame[:-1]))).all():
        return None
    return np.lexsort((frame, camera))


def frame_edges(camera: NDArray[np.integer[Any]], frame: NDArray[np.int64]) -> NDArray[np.int64]:
    """(g + 1,) where the runs of equal camera and frame begin, and the end."""
    new = (camera[1:] != camera[:-1]) | (frame[1:] != frame[:-1])
    return np.concatenate([[0], np.flatnonzero(new) + 1, [len(frame)]])


@compiled(nogil=True, error_model="numpy")
def _cells(camera, pixels, sizes, shape):  # type: ignore[no-untyped-def]
    """(n,) number of the cell that each pixel lies in; pixels outside belong to the edge cells."""
    cells, columns = np.empty(len(camera), dtype=np.int64), np.int64(shape[0])
    for i in range(len(camera)):
        width, height = sizes[camera[i], 0], sizes[camera[i], 1]
        column = min(max((pixels[i, 0] + 0.5) / width * shape[0], 0.0), shape[0] - 1.0)
        row = min(max((pixels[i, 1] + 0.5) / height * shape[1], 0.0), shape[1] - 1.0)
        cells[i] = np.int64(row) * columns + np.int64(column)
    return cells


@compiled(nogil=True, error_model="numpy")
def _best_of_equal_keys(edges, cells, camera, frame, cell, confidence, among):  # type: ignore[no-untyped-def]
    """(n,) which rows have the largest confidence, the first of them, among those of equal keys.

    A hash table with open addressing, at most half full, holds the best row of every key so far;
    rows of different runs ``edges[i]:edges[i + 1]`` have different keys. Where the runs are frames,
    the numbers of their ``cells`` themselves are the places in the table, if it is small enough.
    """
    keep = np.zeros(len(frame), dtype=np.bool_)
    longest = 1
    for run in range(len(edges) - 1):
        longest = max(longest, edges[run + 1] - edges[run])
    direct = 0 < cells <= 4 * longest
    best = np.empty(4 * longest, dtype=np.int64)
    for run in range(len(edges) - 1):
        size = cells if direct else 2
        while not direct and size < 2 * (edges[run + 1] - edges[run]):
            size *= 2
        best[:size] = -1
        for row in range(edges[run], edges[run + 1]):
            if not among[row]:
                continue
            slot = cell[row]
            if not direct:
                mixed = (frame[row] * 1_000_003 + camera[row]) * 10_000_000_019 + cell[row]
                slot = (mixed ^ (mixed >> 29)) & (size - 1)
            other = best[slot]
            while other >= 0 and not (
                cell[other] == cell[row]
                and frame[other] == frame[row]
                and camera[other] == camera[row]
            ):
                slot = (slot + 1) & (size - 1)
                other = best[slot]
            if other < 0 or confidence[row] > confidence[other]:
                best[slot] = row
        for slot in range(size):
            if best[slot] >= 0:
                keep[best[slot]] = True
    return keep
