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

SAME_PLACE = "same_place"
"""Key of a table's metadata: lists of frame numbers, those of one place each."""

PLACES = "places"
"""The same of frames near each other, which show the same objects."""

REPEATED_SHARE = 0.5  # of a frame's matches, equal to the last bit; independent ones have none

_ODD = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9,
                 0xD6E8FEB86659FD93, 0xFF51AFD7ED558CCD], dtype=np.uint64)  # fmt: skip


def number_by_place(metadata: Mapping[str, Any], frame: Numbers) -> Numbers:
    """(n,) frame numbers, those of one place replaced by the first of them.

    Raises:
        CorrespondenceError: if the metadata's ``same_place`` is not a list of lists of numbers.
    """
    numbers = frame
    for place in _lists_of_frames(metadata, SAME_PLACE):
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
    places = [frame[np.isin(frame, place)] for place in _lists_of_frames(metadata, PLACES)]
    named = np.concatenate([np.empty(0, dtype=np.int64), *places])
    return [place for place in (*places, np.setdiff1d(frame, named)) if len(place)]


def _lists_of_frames(metadata: Mapping[str, Any], key: str) -> list[list[int]]:
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
    """(n,) frame numbers, with those of one place or of equal content of a camera replaced.

    Args:
        table: sorted by camera and frame.
        camera: (n,) of its rows.
    """
    if not len(table):
        return table.frame
    edges = frame_edges(camera, table.frame)
    numbers, of_group = table.frame[edges[:-1]], camera[edges[:-1]]
    content = np.add.reduceat(row_hashes(table.pixels_px, table.points_lidar_m), edges[:-1])
    keys = np.column_stack([of_group.astype(np.uint64), np.diff(edges).astype(np.uint64), content])
    _, first, group = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    same = np.repeat(numbers[first[group.ravel()]], np.diff(edges))
    return number_by_place(table.metadata, same)


def row_hashes(pixels_px: NDArray[np.float64], points_lidar_m: NDArray[np.float64]) -> Any:
    """(n,) uint64 of the bits of each correspondence."""
    mixed = np.zeros(len(pixels_px), dtype=np.uint64)
    for column, odd in zip((*pixels_px.T, *points_lidar_m.T), _ODD, strict=True):
        mixed += np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) * odd
        mixed ^= mixed >> np.uint64(31)
    return mixed * _ODD[0]
