"""The paper's correspondence preprocessing, with a count at every filter."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.io.tables import parts_of_table
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences, concatenate, rows_where
from calibgraph.model.rig import Rig
from calibgraph.solver.grid import best_in_cell, frame_edges
from calibgraph.solver.repeats import number_repeats
from calibgraph.solver.shared_error import with_common_error

FILTERS = ("given", "projectable", "confident", "best_in_cell", "capped")
"""The stages at which a camera's correspondences are counted, in order."""

_MERGED_ROWS = 250_000  # rows of parts before they are merged, about 15 to 25 MB


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


def preprocess(rig: Rig, table: Correspondences | Path | str, config: Config) -> Preprocessed:
    """Depth filter, confidence filter, best match per grid cell, cap per camera and frame.

    The table may be a file larger than memory, which is read in parts: memory is needed
    for one row group of it and for what the grid keeps, at most one match of each cell, camera and
    frame, in whatever order the rows are. A CSV file is read whole.

    Raises:
        CorrespondenceError: if the table names a camera that the rig does not have, or states
            another common error than the settings.
        FileError: as of :func:`calibgraph.load_correspondences`.
    """
    parts = [table] if isinstance(table, Correspondences) else parts_of_table(Path(table))
    return preprocess_parts(rig, parts, config)


def preprocess_parts(rig: Rig, parts: Iterable[Correspondences], config: Config) -> Preprocessed:
    """As :func:`preprocess`, of a table in parts, at least one."""
    kept: list[Correspondences] = []
    counts = np.zeros((len(FILTERS), len(rig.cameras)), dtype=np.int64)
    merged_rows = 0
    for part in parts:
        usable = with_common_error(part.without_cameras(config.excluded_cameras), config)
        best, passed = _filter(rig, usable, config)
        counts[:3] += passed
        kept.append(best)
        if sum(map(len, kept)) > 2 * merged_rows + _MERGED_ROWS:
            kept = [_merge(rig, kept, config)]
            merged_rows = len(kept[0])
    table = _merge(rig, kept, config)
    camera = _camera_numbers(rig, table)
    counts[3] = np.bincount(camera, minlength=len(rig.cameras))
    table, camera, repeated = _count_repeats_once(rig, table, camera, config)
    rows = _within_cap(table, camera, config)
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
    """The best rows of a part, by camera and frame.

    And (3, N) per camera, how many are given, projectable, confident.
    """
    camera = _camera_numbers(rig, table)
    projectable = _projectable(rig, table, camera)
    confident = projectable & (table.confidence >= config.confidence_min)
    furthest = projectable.view(np.int8) + confident.view(np.int8)  # the last filter passed
    reached = np.bincount(3 * camera + furthest, minlength=3 * len(rig.cameras)).reshape(-1, 3)
    passed = np.cumsum(reached[:, ::-1], axis=1)[:, ::-1].T
    return table.select(best_in_cell(rig, table, camera, config, among=confident)), passed


def _merge(rig: Rig, kept: Sequence[Correspondences], config: Config) -> Correspondences:
    """The best matches of the parts' best matches, sorted by camera and frame."""
    if len(kept) == 1:
        return kept[0]
    table = concatenate(kept)
    return table.select(best_in_cell(rig, table, _camera_numbers(rig, table), config))


def _camera_numbers(rig: Rig, table: Correspondences) -> NDArray[np.int64]:
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


def _projectable(rig: Rig, table: Correspondences, camera: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(n,) depth filter: Z > 0 and inside the lens' domain, under the rig's current extrinsic."""
    keep = np.empty(len(table), dtype=np.bool_)
    for number, model in enumerate(rig.cameras.values()):
        rows = rows_where(camera == number)
        points = table.points_lidar_m
        own = points[rows] if isinstance(rows, slice) else points.take(rows, axis=0)
        keep[rows] = model.lens.are_projectable(own, model.T_camera_lidar)
    return keep


def _within_cap(
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
