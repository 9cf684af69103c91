"""The paper's correspondence preprocessing (section 3.4), with a count at every filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.config import Config
from calibgraph.correspondences import Correspondences
from calibgraph.errors import CorrespondenceError
from calibgraph.rig import Rig

Array = NDArray[np.float64]

FILTERS = ("given", "projectable", "confident", "best_in_cell", "capped")
"""The stages at which a camera's correspondences are counted, in order."""


@dataclass(frozen=True)
class Preprocessed:
    """Correspondences fit for the graph, sorted by camera and frame.

    Attributes:
        table: the kept correspondences.
        counts: per camera, how many are left after each of FILTERS.
    """

    table: Correspondences
    counts: dict[str, dict[str, int]]


def preprocess(rig: Rig, table: Correspondences, config: Config) -> Preprocessed:
    """Depth filter, confidence filter, best match per grid cell, cap per camera and frame.

    Raises:
        CorrespondenceError: if the table names a camera that the rig does not have.
    """
    for name in table.cameras:
        if name not in rig.cameras:
            raise CorrespondenceError(
                f"camera {name!r} of the correspondences is not in the rig, which has "
                f"{', '.join(map(repr, rig.cameras))}; give it the same name in both",
                camera=name,
            )
    numbers = np.array([list(rig.cameras).index(name) for name in table.cameras], dtype=np.int64)
    camera = numbers[table.camera_index] if len(table) else np.empty(0, np.int64)
    kept = np.arange(len(table))
    counts = [np.bincount(camera, minlength=len(rig.cameras))]
    filters = (_projectable, _confident, _best_in_cell, _capped)
    for keep in filters:
        kept = kept[keep(rig, table.select(kept), camera[kept], config)]
        counts.append(np.bincount(camera[kept], minlength=len(rig.cameras)))
    order = kept[np.lexsort((table.frame[kept], camera[kept]))]
    by_camera = np.array(counts).T.tolist()
    named = {
        name: dict(zip(FILTERS, row, strict=True))
        for name, row in zip(rig.cameras, by_camera, strict=True)
    }
    return Preprocessed(table.select(order), named)


def _projectable(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.bool_]:
    """Depth filter: Z > 0 and inside the lens' domain, under the rig's current extrinsic."""
    keep = np.empty(len(table), dtype=np.bool_)
    for number, model in enumerate(rig.cameras.values()):
        rows = camera == number
        T = model.T_camera_lidar
        keep[rows] = model.lens.project(table.points_lidar_m[rows] @ T[:3, :3].T + T[:3, 3])[1]
    return keep


def _confident(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.bool_]:
    keep: NDArray[np.bool_] = table.confidence >= config.confidence_min
    return keep


def _best_in_cell(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.bool_]:
    """Most confident match of each cell of the image grid, per camera and frame.

    Of equally confident ones the first in the table is kept.
    """
    sizes = np.array([[c.width_px, c.height_px] for c in rig.cameras.values()], dtype=np.float64)
    shape = np.array([config.grid_columns, config.grid_rows])
    cells = np.floor((table.pixels_px + 0.5) / sizes[camera] * shape).astype(np.int64)
    cells = np.clip(cells, 0, shape - 1)
    cell = cells[:, 1] * config.grid_columns + cells[:, 0]
    order = np.lexsort((-table.confidence, cell, table.frame, camera))
    return _first_of_each(order, camera, table.frame, cell)


def _capped(
    rig: Rig, table: Correspondences, camera: NDArray[np.int64], config: Config
) -> NDArray[np.bool_]:
    """The most confident ``matches_max`` of each camera and frame."""
    order = np.lexsort((-table.confidence, table.frame, camera))
    starts = _is_new(camera[order], table.frame[order])
    first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    keep = np.empty(len(order), dtype=np.bool_)
    keep[order] = np.arange(len(order)) - first < config.matches_max
    return keep


def _first_of_each(order: NDArray[np.intp], *keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the rows that come first, in ``order``, among those with equal keys."""
    keep = np.empty(len(order), dtype=np.bool_)
    keep[order] = _is_new(*(key[order] for key in keys))
    return keep


def _is_new(*sorted_keys: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which rows of sorted keys differ from the row before."""
    new = np.ones(len(sorted_keys[0]), dtype=np.bool_)
    new[1:] = np.any([key[1:] != key[:-1] for key in sorted_keys], axis=0)
    return new


def sqrt_information(table: Correspondences, config: Config) -> Array | None:
    """Whitening matrices of the residuals, w_k times the root of the information.

    Returns:
        (n, 3) entries (0,0), (0,1), (1,1) of upper triangular S with S^T S = w^2 I; None if every
        weight is one and no information is given.
    """
    if table.information_px is None and not config.confidence_weights:
        return None
    if table.information_px is None:
        root = np.tile([1.0, 0.0, 1.0], (len(table), 1))
    else:
        root = _upper_root(table.information_px)
    if config.confidence_weights:  # the paper's w = sqrt(clip(c, 0.1, 1))
        root *= np.sqrt(np.clip(table.confidence, 0.1, 1.0))[:, None]
    return root


def _upper_root(information: Array) -> Array:
    """Upper triangular S with S^T S = I, row-wise; rank one gives s11 = 0 (or s00 = s01 = 0)."""
    uu, uv, vv = information.T
    s00 = np.sqrt(uu)
    s01 = np.where(uu > 0, uv / np.where(uu > 0, s00, 1.0), 0.0)
    s11 = np.sqrt(np.maximum(vv - s01**2, 0.0))
    return np.stack([s00, s01, s11], axis=1)


def constrained_error_px(residuals: Array, information: Array | None) -> Array:
    """(n,) length of the residual along the directions that the match constrains [px].

    The plain reprojection error where no information is given; for an edge, the distance from it.
    """
    if information is None:
        return np.asarray(np.hypot(residuals[:, 0], residuals[:, 1]))
    uu, uv, vv = information.T
    largest = (uu + vv) / 2 + np.hypot((uu - vv) / 2, uv)
    x, y = residuals.T
    squared = uu * x**2 + 2 * uv * x * y + vv * y**2
    return np.asarray(np.sqrt(np.maximum(squared, 0.0) / largest))
