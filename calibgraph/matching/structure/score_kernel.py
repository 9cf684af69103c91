"""The kernel that scores windows against an image at every shift of a grid.

Where the time of a calibration goes. Four points of a window are taken in one pass over a row of
shifts, so that a sum is loaded and stored once for four products; the sums are arrays of their own,
which the compiler can tell apart, padded to whole vectors. The image has zero mean, which keeps
single precision: its sum of squares is then not the difference of two large numbers.
"""

from __future__ import annotations

import numpy as np
from numba import njit

GRAY_NOISE = 0.05  # logarithm of gray: below, a window counts as flat in the image
MIN_RESIDUAL_SHARE = 0.1  # share of its variance that an image cannot share with a cloud, at best
LANES = 16  # floats in the widest vector of current processors


@njit(cache=True, fastmath=True, nogil=True)
def score_windows(image, places, counts, basis, group, origin, likelihood, grids):  # type: ignore[no-untyped-def]
    """Add every window's score at all shifts to its group's grid.

    image: (h, w); places: (n, l, 2) nearest pixels (u, v) at shift 0; counts: (n,);
    basis: (n, l, 4), of which the last two columns are zero where ``likelihood``; group: (n,);
    origin: (2,) the first shift (u, v) of the grids; grids: (g, s, s).
    The score is d_D^2 + d_I |d_I|, with d the image's components along the columns of the basis,
    over the image's own variation: squared for depth, whose sign in an image is unknown, and signed
    for intensity. It is a share r of explained variance, or (likelihood) the -log(1 - r) of a
    Gaussian window. Shifts at which a window leaves the image count 0.
    """
    height, width = image.shape
    rows, columns = grids.shape[1], grids.shape[2]
    pixels = np.zeros(height * width + LANES, np.float32)  # vectors may read beyond the last one
    pixels[: height * width] = image.reshape(-1) - np.float32(image.mean())
    depth, intensity = np.empty(columns + LANES, np.float32), np.empty(columns + LANES, np.float32)
    trend_u, trend_v = np.empty(columns + LANES, np.float32), np.empty(columns + LANES, np.float32)
    total, power = np.empty(columns + LANES, np.float32), np.empty(columns + LANES, np.float32)
    start = np.empty(places.shape[1], np.int64)
    for w in range(places.shape[0]):
        n = counts[w]
        left, right = places[w, :n, 0].min(), places[w, :n, 0].max()
        top, bottom = places[w, :n, 1].min(), places[w, :n, 1].max()
        first = max(origin[0], -left)
        size = min(origin[0] + columns, width - right) - first
        if size <= 0:
            continue
        padded = (size + LANES - 1) // LANES * LANES
        for p in range(n):
            start[p] = places[w, p, 1] * width + places[w, p, 0] + first
        for shift in range(max(origin[1], -top), min(origin[1] + rows, height - bottom)):
            below = shift * width
            depth[:padded] = 0
            intensity[:padded] = 0
            total[:padded] = 0
            power[:padded] = np.float32(n * GRAY_NOISE**2)
            if not likelihood:
                trend_u[:padded] = 0
                trend_v[:padded] = 0
            for p in range(0, n - 3, 4):
                i0, i1 = start[p] + below, start[p + 1] + below
                i2, i3 = start[p + 2] + below, start[p + 3] + below
                row0, row1 = pixels[i0 : i0 + padded], pixels[i1 : i1 + padded]
                row2, row3 = pixels[i2 : i2 + padded], pixels[i3 : i3 + padded]
                a0, b0, c0, d0 = basis[w, p, 0], basis[w, p, 1], basis[w, p, 2], basis[w, p, 3]
                p1, p2, p3 = p + 1, p + 2, p + 3
                a1, b1, c1, d1 = basis[w, p1, 0], basis[w, p1, 1], basis[w, p1, 2], basis[w, p1, 3]
                a2, b2, c2, d2 = basis[w, p2, 0], basis[w, p2, 1], basis[w, p2, 2], basis[w, p2, 3]
                a3, b3, c3, d3 = basis[w, p3, 0], basis[w, p3, 1], basis[w, p3, 2], basis[w, p3, 3]
                for k in range(padded):
                    v0, v1, v2, v3 = row0[k], row1[k], row2[k], row3[k]
                    depth[k] += a0 * v0 + a1 * v1 + a2 * v2 + a3 * v3
                    intensity[k] += b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3
                    total[k] += v0 + v1 + v2 + v3
                    power[k] += v0 * v0 + v1 * v1 + v2 * v2 + v3 * v3
                if not likelihood:
                    for k in range(padded):
                        v0, v1, v2, v3 = row0[k], row1[k], row2[k], row3[k]
                        trend_u[k] += c0 * v0 + c1 * v1 + c2 * v2 + c3 * v3
                        trend_v[k] += d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3
            for p in range(n - n % 4, n):
                row0 = pixels[start[p] + below : start[p] + below + padded]
                a0, b0, c0, d0 = basis[w, p, 0], basis[w, p, 1], basis[w, p, 2], basis[w, p, 3]
                for k in range(padded):
                    v0 = row0[k]
                    depth[k] += a0 * v0
                    intensity[k] += b0 * v0
                    total[k] += v0
                    power[k] += v0 * v0
                if not likelihood:
                    for k in range(padded):
                        trend_u[k] += c0 * row0[k]
                        trend_v[k] += d0 * row0[k]
            grid = grids[group[w], shift - origin[1], first - origin[0] : first - origin[0] + size]
            if likelihood:
                for k in range(size):
                    variation = power[k] - total[k] * total[k] / np.float32(n)
                    score = depth[k] * depth[k] + intensity[k] * abs(intensity[k])
                    share = score / variation
                    residual = np.float32(1 + MIN_RESIDUAL_SHARE) - abs(share)
                    gain = np.log(np.float32(1 + MIN_RESIDUAL_SHARE) / residual)
                    grid[k] += np.copysign(gain, share)
            else:
                for k in range(size):
                    variation = power[k] - total[k] * total[k] / np.float32(n)
                    variation -= trend_u[k] * trend_u[k] + trend_v[k] * trend_v[k]
                    score = depth[k] * depth[k] + intensity[k] * abs(intensity[k])
                    grid[k] += score / variation
