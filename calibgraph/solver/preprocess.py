"""The paper's preprocessing, with a count at every filter; repeated frames count as one."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences, rows_where
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.rig import Rig
from factors.arrays import contiguous
from factors.compiled import compiled

FILTERS = ("given", "projectable", "confident", "best_in_cell", "capped")
"""The stages at which a camera's correspondences are counted, in order."""


@dataclass(frozen=True)
class Preprocessed:
    """Preprocessed correspondences, sorted by camera and frame.

    Attributes:
        table: the kept correspondences.
        counts: per camera, how many are left after each of FILTERS.
        repeated_frames: per camera, how many frames count as part of another one.
    """

    table: Correspondences
    counts: dict[str, dict[str, int]]
    repeated_frames: dict[str, int]


def with_common_error(table: Correspondences, config: Config) -> Correspondences:
    """The table with the common error of the settings in its metadata, if they have one.

    Raises:
        CorrespondenceError: if the table states another one.
    """
    if (config.common_deg, config.common_cm) == (None, None):
        return table
    rotation_rad, translation_m = np.radians(config.common_deg or 0), (config.common_cm or 0) / 100
    wanted, found = (float(rotation_rad), translation_m), table.findings
    if not found.states_common_error:
        return table.with_findings(
            MatcherFindings(systematic_rotation_rad=wanted[0], systematic_translation_m=wanted[1])
        )
    if found.systematic_sigmas != wanted:
        rotation_rad, translation_m = found.systematic_sigmas
        raise CorrespondenceError(
            f"the table states that its frames share {np.degrees(rotation_rad):.3g} deg and "
            f"{100 * translation_m:.3g} cm; leave common_deg and common_cm out"
        )
    return table


def preprocess(rig: Rig, table: Correspondences, config: Config) -> Preprocessed:
    """Depth filter, confidence filter, best match per grid cell, cap per camera and frame.

    Raises:
        CorrespondenceError: if the table names a camera that the rig does not have, or states
            another common error than the settings.
    """
    usable = with_common_error(table.without_cameras(config.excluded_cameras), config)
    counts = np.zeros((len(FILTERS), len(rig.cameras)), dtype=np.int64)
    table, counts[:3] = _filter(rig, usable, config)
    camera = camera_numbers(rig, table)
    counts[3] = np.bincount(camera, minlength=len(rig.cameras))
    table, camera, repeated = _count_repeats_once(rig, table, camera, config)
    rows = within_cap(table, camera, config)
    if rows is not None:
        table, camera = table.select(rows), camera[rows]
    counts[4] = np.bincount(camera, minlength=len(rig.cameras))
    named = {
        name: dict(zip(FILTERS, column, strict=True))
        for name, column in zip(rig.cameras, counts.T.tolist(), strict=True)
    }
    return Preprocessed(table, named, repeated)


def _count_repeats_once(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> tuple[Correspondences, NDArray[np.int64], dict[str, int]]:
    """Frames that repeat another one become part of it: the best match of each cell is kept.

    Args:
        rig: for the sizes of the images.
        table: sorted by camera and frame.
        camera: (n,) of its rows.
        config: the grid.

    Returns:
        The table, so sorted, the cameras of its rows, and per camera how many frames are repeats.
    """
    frame = number_repeats(table, camera)
    if np.array_equal(frame, table.frame):
        return table, camera, dict.fromkeys(rig.cameras, 0)
    before = _frames_by_camera(rig, table, camera)
    table = replace(table, frame=frame)
    best = best_in_cell(rig, table, camera, config)
    table, camera = table.select(best), camera[best]
    after = _frames_by_camera(rig, table, camera)
    return table, camera, {name: before[name] - after[name] for name in rig.cameras}


def _frames_by_camera(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64]
) -> dict[str, int]:
    """Per camera, its number of frames; of a table sorted by camera and frame."""
    first = frame_edges(camera, table.frame)[:-1]
    frames = np.bincount(camera[first], minlength=len(rig.cameras))
    return dict(zip(rig.cameras, frames.tolist(), strict=True))


def _filter(
    rig: Rig, table: Correspondences, config: Config
) -> tuple[Correspondences, NDArray[np.int64]]:
    """The best rows, by camera and frame.

    And (3, N) per camera, how many are given, projectable, confident.
    """
    camera = camera_numbers(rig, table)
    projectable = are_projectable(rig, table, camera)
    confident = projectable & (table.confidence >= config.confidence_min)
    furthest = projectable.view(np.int8) + confident.view(np.int8)  # the last filter passed
    reached = np.bincount(3 * camera + furthest, minlength=3 * len(rig.cameras)).reshape(-1, 3)
    passed = np.cumsum(reached[:, ::-1], axis=1)[:, ::-1].T
    return table.select(best_in_cell(rig, table, camera, config, among=confident)), passed


def camera_numbers(rig: Rig, table: Correspondences) -> NDArray[np.int64]:
    """(n,) index of each row's camera in the rig."""
    for name in table.cameras:
        if name not in rig.cameras:
            raise CorrespondenceError(
                f"camera {name!r} of the correspondences is not in the rig, which has "
                f"{', '.join(map(repr, rig.cameras))}; give it the same name in both",
                camera=name,
            )
    numbers = np.array([list(rig.cameras).index(name) for name in table.cameras], dtype=np.int64)
    return numbers.take(table.camera_index) if len(table) else np.empty(0, np.int64)


def are_projectable(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """(n,) depth filter: Z > 0 and inside the lens' domain, under the rig's current extrinsic."""
    keep = np.empty(len(table), dtype=np.bool_)
    for number, model in enumerate(rig.cameras.values()):
        rows = rows_where(camera == number)
        points = table.points_lidar_m
        own = points[rows] if isinstance(rows, slice) else points.take(rows, axis=0)
        keep[rows] = model.lens.project(own, model.T_camera_lidar)[1]
    return keep


def within_cap(
    table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.int64] | None:
    """The rows that are the most confident ``matches_max`` of their camera and frame; None: all.

    Args:
        table: sorted by camera and frame.
        camera: (n,) of its rows.
        config: ``matches_max``.
    """
    edges = frame_edges(camera, table.frame)
    if not len(table) or np.diff(edges).max() <= config.matches_max:
        return None
    group = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    order = np.lexsort((-table.confidence, group))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order)) - edges[group]
    return np.flatnonzero(rank < config.matches_max)


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
    among = np.ones(len(table), dtype=np.bool_) if among is None else among
    cell, cells = np.zeros(len(table), np.int64), config.grid_columns * config.grid_rows
    for axis, count in ((1, config.grid_rows), (0, config.grid_columns)):
        place = (table.pixels_px[:, axis] + 0.5) / sizes[:, axis].take(camera) * count
        place = np.minimum(np.maximum(place, 0.0), count - 1.0)  # from outside into edge cells
        cell = count * cell + place.astype(np.int64)
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
    given = (contiguous(array) for array in (cell, confidence, among))
    _keep_best(edges, np.full(cells, -1), *given, keep)
    return keep


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


def point_hashes(points: Array) -> Hashes:
    """(n,) uint64 of the bits of each point of (n, 2) or (n, 3)."""
    mixed = np.zeros(len(points), dtype=np.uint64)
    for column, odd in zip(points.T, _ODD, strict=False):
        mixed += np.ascontiguousarray(column, dtype=np.float64).view(np.uint64) * odd
        mixed ^= mixed >> np.uint64(31)
    return np.asarray(mixed * _ODD[0])
