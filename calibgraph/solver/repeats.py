"""Repeated frames: those of one place, or of equal content, count as one frame.

While a vehicle stands, every frame has the same errors; so have copies of a frame. Taken for
independent, they would make the error bar too small, down to nothing.
"""

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.grid import frame_edges

Numbers = NDArray[np.int64]
Hashes = NDArray[np.uint64]

REPEATED_SHARE = 0.5
"""Of a frame's points, that are those of another one, to the last bit: two scans have none in
common."""

_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def number_repeats(table: Correspondences, camera: Numbers) -> Numbers:
    """(n,) frame numbers, with those of one place or of one cloud of a camera replaced.

    Frames are of one cloud if more than half of their points are the same: copies of a frame, also
    where they were matched anew.

    Args:
        table: sorted by camera and frame.
        camera: (n,) of its rows.
    """
    if not len(table):
        return table.frame
    edges = frame_edges(camera, table.frame)
    if (np.diff(camera[edges[:-1]]) > 0).all():  # one frame of each camera
        return table.places.merge_stationary(table.frame)
    hashes = point_hashes(table.points_lidar_m) + camera.astype(np.uint64) * _ODD[0]
    numbers = table.frame[edges[:-1]]
    if _have_repeats(hashes):
        numbers = numbers[_first_of_same_content(hashes, np.diff(edges))]
    return table.places.merge_stationary(np.repeat(numbers, np.diff(edges)))


def _have_repeats(hashes: Hashes) -> bool:
    ordered = np.sort(hashes)
    return bool((ordered[1:] == ordered[:-1]).any())


def _first_of_same_content(hashes: Hashes, counts: Numbers) -> Numbers:
    """(f,) for each frame the first one that has more than half of the rows of either in common.

    Args:
        hashes: (n,) of the rows, frame by frame.
        counts: (f,) of rows.
    """
    frame = np.repeat(np.arange(len(counts)), counts)
    _, first, row = np.unique(hashes, return_index=True, return_inverse=True)
    earlier = frame[first[row]]  # that has this row, too
    pairs, common = np.unique(
        np.column_stack([earlier, frame])[earlier < frame], axis=0, return_counts=True
    )
    alike = common > REPEATED_SHARE * counts[pairs].min(axis=1)
    found = np.arange(len(counts))
    for one, other in pairs[alike]:
        found[other] = min(found[other], found[one])
    return found


def hash_numbers(points_lidar_m: NDArray[np.float64]) -> list[int]:
    """:func:`point_hashes` as numbers: a set of some hundred is faster than arrays."""
    numbers: list[int] = point_hashes(points_lidar_m).tolist()
    return numbers


def point_hashes(points_lidar_m: NDArray[np.float64]) -> Hashes:
    """(n,) uint64 of the bits of each point."""
    mixed = np.zeros(len(points_lidar_m), dtype=np.uint64)
    for column, odd in zip(points_lidar_m.T, _ODD, strict=True):
        mixed += np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) * odd
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed * _ODD[0])
