"""Repeated frames: those of one place, or of equal content, count as one frame.

While a vehicle stands, every frame has the same errors; so have copies of a frame. Taken for
independent, they would make the error bar too small, down to nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.model.correspondences import Correspondences
from calibgraph.solver.grid import frame_edges

Numbers = NDArray[np.int64]
Hashes = NDArray[np.uint64]

SAME_PLACE = "same_place"
"""Key of a table's metadata: lists of frame numbers, those of one place each."""

PLACES = "places"
"""The same of frames near each other, which show the same objects."""

REPEATED_SHARE = 0.5
"""Of a frame's points, that are those of another one, to the last bit: two scans have none in
common."""

_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)


def number_by_place(metadata: Mapping[str, Any], frame: Numbers) -> Numbers:
    """(n,) frame numbers, those of one place replaced by the first of them.

    Raises:
        CorrespondenceError: if the metadata's ``same_place`` is not a list of lists of numbers.
    """
    numbers = frame
    for place in lists_of_frames(metadata, SAME_PLACE):
        numbers = np.where(np.isin(frame, place), np.int64(place[0]), numbers)
    return numbers


def frames_of_one_place(metadata: Mapping[str, Any], frame: Numbers) -> float:
    """How many frames share what a place shares, in the mean over frames.

    Args:
        metadata: of a table; frames in none of its ``places`` are all of one place.
        frame: (f,) numbers of a camera's frames.

    Raises:
        CorrespondenceError: if ``places`` is not a list of lists of numbers.
    """
    counts = [len(place) for place in split_places(metadata, frame)]
    return float(np.square(counts).sum() / max(1, len(frame)))


def split_places(metadata: Mapping[str, Any], frame: Numbers) -> list[Numbers]:
    """The numbers of a camera's frames, place by place; arguments as of `frames_of_one_place`."""
    lists = lists_of_frames(metadata, PLACES)
    place_of = {number: place for place, numbers in enumerate(lists) for number in numbers}
    place = np.array([place_of.get(number, len(lists)) for number in frame.tolist()], np.int64)
    order = np.argsort(place, kind="stable")
    edges = np.flatnonzero(np.diff(place[order])) + 1
    return [part for part in np.split(frame[order], edges) if len(part)]


def lists_of_frames(metadata: Mapping[str, Any], key: str) -> list[list[int]]:
    """The lists under a key of a table's metadata; none if it is not there.

    Raises:
        CorrespondenceError: if they are not lists of frame numbers.
    """
    places = metadata.get(key, [])
    good = isinstance(places, list) and all(
        isinstance(place, list) and place and all(type(number) is int for number in place)
        for place in places
    )
    if not good:
        raise CorrespondenceError(
            f"{key} of the table's metadata must be lists of frame numbers, as in "
            f"[[0, 1, 2], [7, 8]], found {places!r:.60}"
        )
    return list(places)


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
    hashes = point_hashes(table.points_lidar_m) + camera.astype(np.uint64) * _ODD[0]
    numbers = table.frame[edges[:-1]]
    if _have_repeats(hashes):
        numbers = numbers[_first_of_same_content(hashes, np.diff(edges))]
    return number_by_place(table.metadata, np.repeat(numbers, np.diff(edges)))


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


def point_hashes(points_lidar_m: NDArray[np.float64]) -> Hashes:
    """(n,) uint64 of the bits of each point."""
    mixed = np.zeros(len(points_lidar_m), dtype=np.uint64)
    for column, odd in zip(points_lidar_m.T, _ODD, strict=True):
        mixed += np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) * odd
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed * _ODD[0])
