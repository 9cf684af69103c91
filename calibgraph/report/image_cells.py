"""Correspondences by cells of the image: counts and mean residuals."""

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.rig import Camera
from calibgraph.report.reprojection_errors import ReprojectionErrors

Array = NDArray[np.float64]

_MIN_PER_CELL = 3  # for a mean


def grid_shape(camera: Camera, columns: int) -> tuple[int, int]:
    """Columns and rows of a grid of about square cells."""
    return columns, max(1, round(columns * camera.height_px / camera.width_px))


def count_per_cell(pixels_px: Array, camera: Camera, shape: tuple[int, int]) -> NDArray[np.intp]:
    """(rows, columns) number of pixels in each cell."""
    number = _cell_numbers(pixels_px, camera, shape)
    counts = np.bincount(number, minlength=shape[0] * shape[1])
    return np.asarray(counts.reshape(shape[1], shape[0]))


def mean_residuals(
    camera: Camera, errors: ReprojectionErrors, columns: int
) -> tuple[Array, Array, float]:
    """The mean residual of each cell that has at least three.

    Returns:
        (m, 2) centres of these cells [px], (m, 2) their means [px], the width of a cell [px].
    """
    shape = grid_shape(camera, columns)
    number = _cell_numbers(errors.pixels_px, camera, shape)
    counts = count_per_cell(errors.pixels_px, camera, shape).ravel()
    sums = [np.bincount(number, weights=v, minlength=len(counts)) for v in errors.vectors_px.T]
    full = np.flatnonzero(counts >= _MIN_PER_CELL)
    means = np.column_stack(sums)[full] / counts[full, None]
    size = np.array([camera.width_px, camera.height_px])
    places = np.column_stack([full % shape[0], full // shape[0]])
    return (places + 0.5) / shape * size - 0.5, means, camera.width_px / shape[0]


def _cell_numbers(pixels_px: Array, camera: Camera, shape: tuple[int, int]) -> NDArray[np.intp]:
    """(n,) each pixel's cell, numbered row by row."""
    size, last = np.array([camera.width_px, camera.height_px]), np.array(shape) - 1
    at = np.floor((pixels_px + 0.5) / size * shape).astype(np.intp)
    column, row = np.clip(at, 0, last).T
    return np.asarray(row * shape[0] + column)
