"""Kernels of the correlation maps: z-scores of many transforms.

The maps of all groups are far larger than any cache, so each map is read for many transforms.
"""

import math

import numpy as np

from factors.compiled import compiled

HALF_PI, PI = np.float32(math.pi / 2), np.float32(math.pi)
TRANSFORMS_AT_ONCE = 16  # whose grids of shifts stay in the second-level cache


@compiled(fastmath=True)
def _atan2(y, x):  # type: ignore[no-untyped-def]
    """The angle of (x, y), to 1e-5 rad, without branches, so that loops vectorize.

    A minimax polynomial of the arctangent on [0, 1]: Abramowitz and Stegun, 4.4.49.
    """
    wide, high = abs(x), abs(y)
    least, most = min(wide, high), max(wide, high)
    t = least / (most + np.float32(1e-30))
    s = t * t
    p = np.float32(-0.0851330) + s * np.float32(0.0208351)
    p = np.float32(0.1801410) + s * p
    p = np.float32(-0.3302995) + s * p
    angle = t * (np.float32(0.9998660) + s * p)
    angle = HALF_PI - angle if high > wide else angle
    angle = PI - angle if x < 0 else angle
    return -angle if y < 0 else angle


@compiled(fastmath=True)
def _project_to_cells(transforms, point, grid, us, vs):  # type: ignore[no-untyped-def]
    """Places (column, row) of a point in the maps, for transforms (12, n)."""
    px, py, pz = np.float32(point[0]), np.float32(point[1]), np.float32(point[2])
    left, top, step = np.float32(grid[0]), np.float32(grid[1]), np.float32(grid[2])
    T = transforms
    for i in range(T.shape[1]):
        x = T[0, i] * px + T[1, i] * py + T[2, i] * pz + T[3, i]
        y = T[4, i] * px + T[5, i] * py + T[6, i] * pz + T[7, i]
        z = T[8, i] * px + T[9, i] * py + T[10, i] * pz + T[11, i]
        us[i] = (_atan2(x, z) - left) / step
        vs[i] = (_atan2(y, np.sqrt(x * x + z * z)) - top) / step


@compiled(fastmath=True)
def sum_z_scores(maps, variances, points, transforms, grid, least, out):  # type: ignore[no-untyped-def]
    """Per transform the sum of bilinearly interpolated scores, over its standard deviation.

    transforms: (12, n) the first rows of T_camera_lidar, a column each; out: (n,).
    """
    n, height, width = transforms.shape[1], maps.shape[1], maps.shape[2]
    us, vs = np.empty(n, np.float32), np.empty(n, np.float32)
    corner, variance = np.empty(n, np.int32), np.full(n, least)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    out[:] = 0
    for g in range(len(maps)):
        _project_to_cells(transforms, points[g], grid, us, vs)
        of_group = variances[g]
        for i in range(n):
            inside = (us[i] >= 0) & (vs[i] >= 0) & (us[i] < right) & (vs[i] < bottom)
            u, v = us[i] if inside else np.float32(0), vs[i] if inside else np.float32(0)
            column, row = np.int32(u), np.int32(v)
            corner[i] = row * width + column
            us[i] = u - np.float32(column)
            vs[i] = v - np.float32(row) if inside else np.float32(-1)
            variance[i] += of_group if inside else 0.0
        values = maps[g].reshape(-1)
        for i in range(n):
            if vs[i] < 0:
                continue
            at, x = corner[i], us[i]
            above = values[at] + x * (values[at + 1] - values[at])
            below = values[at + width] + x * (values[at + width + 1] - values[at + width])
            out[i] += above + vs[i] * (below - above)
    for i in range(n):
        out[i] /= np.sqrt(variance[i])


@compiled(fastmath=True)
def find_best_shifts(maps, variances, points, transforms, grid, least, reach, out):  # type: ignore[no-untyped-def]
    """Per transform (z-score, cells right, cells down) of the best shift of all groups together.

    transforms: as of :func:`sum_z_scores`; reach: (2,) cells; out: (n, 3).
    """
    height, width = maps.shape[1], maps.shape[2]
    columns, rows = 2 * reach[0] + 1, 2 * reach[1] + 1
    shape = (TRANSFORMS_AT_ONCE, rows, columns)
    totals = np.empty(shape, np.float32)
    variance = np.empty((TRANSFORMS_AT_ONCE, rows + 1, columns + 1), np.float32)
    us, vs = np.empty(TRANSFORMS_AT_ONCE, np.float32), np.empty(TRANSFORMS_AT_ONCE, np.float32)
    for start in range(0, transforms.shape[1], TRANSFORMS_AT_ONCE):
        end = min(start + TRANSFORMS_AT_ONCE, transforms.shape[1])
        some = np.ascontiguousarray(transforms[:, start:end])
        totals[:], variance[:] = 0, 0
        for g in range(len(maps)):
            _project_to_cells(some, points[g], grid, us, vs)
            for i in range(end - start):
                left, top = int(np.rint(us[i])) - reach[0], int(np.rint(vs[i])) - reach[1]
                first, last = max(0, -left), min(columns, width - left)
                above, below = max(0, -top), min(rows, height - top)
                if first >= last or above >= below:
                    continue
                for row in range(above, below):
                    total = totals[i, row, first:last]
                    values = maps[g, top + row, left + first : left + last]
                    for k in range(len(total)):
                        total[k] += values[k]
                variance[i, above, first] += variances[g]  # corners of a box, summed up below
                variance[i, above, last] -= variances[g]
                variance[i, below, first] -= variances[g]
                variance[i, below, last] += variances[g]
        for i in range(end - start):
            _find_best_shift(totals[i], variance[i], least, reach, out[start + i])


@compiled(fastmath=True)
def _find_best_shift(total, variance, least, reach, out):  # type: ignore[no-untyped-def]
    rows, columns = total.shape
    for row in range(rows):
        for column in range(1, columns):
            variance[row, column] += variance[row, column - 1]
    for row in range(rows):
        for column in range(columns):
            if row > 0:
                variance[row, column] += variance[row - 1, column]
            total[row, column] /= np.sqrt(variance[row, column] + np.float32(least))
    best = total.argmax()
    out[0] = total[best // columns, best % columns]
    out[1] = best % columns - reach[0]
    out[2] = best // columns - reach[1]
