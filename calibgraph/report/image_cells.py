"""Correspondences by cells of the image: counts and mean residuals."""

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.rig import Camera
from calibgraph.report.reprojection_errors import ReprojectionErrors

_MIN_PER_CELL = 3  # for a mean


def sum_per_cell(
    pixels_px: Array, camera: Camera, columns: int, values: Array | None = None
) -> Array:
    """(rows, columns) sum of (n,) values of the pixels in each cell, or their number.

    The cells are about square.
    """
    size = np.array([camera.width_px, camera.height_px])
    rows = max(1, round(columns * camera.height_px / camera.width_px))
    u, v = np.clip(pixels_px + 0.5, 0, size).T
    sums = np.histogram2d(v, u, (rows, columns), [(0, size[1]), (0, size[0])], weights=values)[0]
    return np.asarray(sums)


def mean_residuals(
    camera: Camera, errors: ReprojectionErrors, columns: int
) -> tuple[Array, Array, float]:
    """The mean residual of each cell that has at least three.

    Returns:
        (m, 2) centres of these cells [px], (m, 2) their means [px], the width of a cell [px].
    """
    counts = sum_per_cell(errors.pixels_px, camera, columns)
    full = np.nonzero(counts >= _MIN_PER_CELL)
    sums = [sum_per_cell(errors.pixels_px, camera, columns, v)[full] for v in errors.vectors_px.T]
    cell = np.array([camera.width_px / columns, camera.height_px / len(counts)])
    centres = (np.column_stack(full[::-1]) + 0.5) * cell - 0.5
    return centres, np.column_stack(sums) / counts[full][:, None], float(cell[0])
