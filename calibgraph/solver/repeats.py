"""Repeated frames: those of one place, or of equal content, count as one frame.

While a vehicle stands, every frame has the same errors; so have copies of a frame. Taken for
independent, they would make the error bar too small, down to nothing. A camera or a LiDAR that is
stuck repeats its pixels or its points, while the other moves on.
"""

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.grid import frame_edges

Numbers = NDArray[np.int64]
Hashes = NDArray[np.uint64]

REPEATED_SHARE = 0.5
"""Of a frame's points or pixels, that are those of another one, to the last bit: two scans have
none in common, nor have two images, where pixels are not of a grid."""
GRID_SHARE = 0.5
"""Distinct columns over distinct pixels of a table, below which its pixels are of a grid, as those
of a dense matcher: every frame has the same."""

_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def number_repeats(table: Correspondences, camera: Numbers) -> Numbers:
    """(n,) frame numbers, with those of one place, cloud or image of a camera replaced.

    Frames are of one cloud if more than half of their points are the same, of one image if more
    than half of their pixels are: copies of a frame, also where they were matched anew.

    Args:
        table: sorted by camera and frame.
        camera: (n,) of its rows.
    """
    if not len(table):
        return table.frame
    edges = frame_edges(camera, table.frame)
    if (np.diff(camera[edges[:-1]]) > 0).all():  # one frame of each camera
        return table.places.merge_stationary(table.frame)
    of_camera, counts = camera.astype(np.uint64) * _ODD[0], np.diff(edges)
    numbers = table.frame[edges[:-1]]
    for values in (table.points_lidar_m, table.pixels_px):
        hashes = point_hashes(values) + of_camera
        if _have_repeats(hashes) and not _are_of_a_grid(values, hashes):
            numbers = numbers[_first_of_same_content(hashes, counts)]
    return table.places.merge_stationary(np.repeat(numbers, counts))


def _are_of_a_grid(values: Array, hashes: Hashes) -> bool:
    """Whether these are pixels of a grid."""
    if values.shape[1] > len("uv"):
        return False
    return len(np.unique(values[:, 0])) < GRID_SHARE * len(np.unique(hashes))


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


def hash_numbers(points_lidar_m: Array) -> list[int]:
    """:func:`point_hashes` as numbers: a set of some hundred is faster than arrays."""
    numbers: list[int] = point_hashes(points_lidar_m).tolist()
    return numbers


def point_hashes(points: Array) -> Hashes:
    """(n,) uint64 of the bits of each point of (n, 2) or (n, 3)."""
    mixed = np.zeros(len(points), dtype=np.uint64)
    for column, odd in zip(points.T, _ODD, strict=False):
        mixed += np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) * odd
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed * _ODD[0])
