"""Kernels of the correlation maps: z-scores of many transforms."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, fastmath=True, nogil=True)
def _project_to_cell(T, point, grid):  # type: ignore[no-untyped-def]
    """Place (column, row) of a point in the maps."""
    x = T[0, 0] * point[0] + T[0, 1] * point[1] + T[0, 2] * point[2] + T[0, 3]
    y = T[1, 0] * point[0] + T[1, 1] * point[1] + T[1, 2] * point[2] + T[1, 3]
    z = T[2, 0] * point[0] + T[2, 1] * point[1] + T[2, 2] * point[2] + T[2, 3]
    right, down = np.arctan2(x, z), np.arctan2(y, np.sqrt(x * x + z * z))
    return (right - grid[0]) / grid[2], (down - grid[1]) / grid[2]


@njit(cache=True, fastmath=True, nogil=True)
def sum_z_scores(maps, variances, points, transforms, grid, least, out):  # type: ignore[no-untyped-def]
    """Per transform the sum of bilinearly interpolated scores, over its standard deviation."""
    height, width = maps.shape[1], maps.shape[2]
    for i in range(transforms.shape[0]):
        total, variance = 0.0, least
        for g in range(maps.shape[0]):
            u, v = _project_to_cell(transforms[i], points[g], grid)
            if u < 0 or v < 0 or u >= width - 1 or v >= height - 1:
                continue
            a, b = int(u), int(v)
            x, y = u - a, v - b
            total += (1 - y) * ((1 - x) * maps[g, b, a] + x * maps[g, b, a + 1])
            total += y * ((1 - x) * maps[g, b + 1, a] + x * maps[g, b + 1, a + 1])
            variance += variances[g]
        out[i] = total / np.sqrt(variance)


@njit(cache=True, fastmath=True, nogil=True)
def find_best_shifts(maps, variances, points, transforms, grid, least, reach, out):  # type: ignore[no-untyped-def]
    """Per transform (z-score, cells right, cells down) of the best shift of all groups together."""
    height, width = maps.shape[1], maps.shape[2]
    columns, rows = 2 * reach[0] + 1, 2 * reach[1] + 1
    total = np.empty((rows, columns), np.float32)
    variance = np.empty((rows + 1, columns + 1), np.float32)
    for i in range(transforms.shape[0]):
        total[:], variance[:] = 0, 0
        for g in range(maps.shape[0]):
            u, v = _project_to_cell(transforms[i], points[g], grid)
            left, top = int(np.rint(u)) - reach[0], int(np.rint(v)) - reach[1]
            first, last = max(0, -left), min(columns, width - left)
            above, below = max(0, -top), min(rows, height - top)
            if first >= last or above >= below:
                continue
            for row in range(above, below):
                for column in range(first, last):
                    total[row, column] += maps[g, top + row, left + column]
            variance[above, first] += variances[g]  # corners of a box, summed up below
            variance[above, last] -= variances[g]
            variance[below, first] -= variances[g]
            variance[below, last] += variances[g]
        for row in range(rows):
            for column in range(1, columns):
                variance[row, column] += variance[row, column - 1]
        for row in range(rows):
            for column in range(columns):
                if row > 0:
                    variance[row, column] += variance[row - 1, column]
                total[row, column] /= np.sqrt(variance[row, column] + np.float32(least))
        best = total.argmax()
        out[i, 0] = total[best // columns, best % columns]
        out[i, 1] = best % columns - reach[0]
        out[i, 2] = best // columns - reach[1]
