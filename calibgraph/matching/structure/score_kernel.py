"""The kernel that scores windows against an image at every shift of a grid.

Where the time of a calibration goes. What makes it fast, measured against a matrix product by
``benchmarks.speed.kernel``: the part of the image that a window meets is copied to a patch, in
which all rows of shifts are one row, of the length that vectors like; five points of the window
are multiplied in one pass over it, so that a sum is loaded and stored once for five products; the
sums are arrays of their own, which the compiler can tell apart. The image has zero mean, which
keeps single precision: its sum of squares is then not the difference of two large numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

GRAY_NOISE = 0.05  # of the logarithm of gray: below, a window counts as flat in the image
MIN_RESIDUAL_SHARE = 0.1  # of an image's variance, which no cloud explains
LANES = 8  # floats of a vector that all current processors have
MAX_SUMS = 768  # shifts whose sums are held at once: they stay in the first-level cache
MIN_PATCH_SHARE = 0.35  # of a patch that is of use; below, rows of shifts are taken one by one
OPPOSITE = np.float32(0.5)
"""Weight of an image that is dark where the intensity is high. Leaves are bright in the near
infrared, and markings are bright in both: on recordings with much of the former, a weight of -1
cost a third of the z-score and up to 50 cm, with much of the latter, 1 cost a tenth."""
CHANCE_DEPTH, CHANCE_INTENSITY = 0.13, 0.05
"""Shares of a structured image's variation that an unrelated window explains. Without them,
windows would rather lie on any structure than on the flat image that they belong to."""
FACTORS = 16  # multiplied before a logarithm is taken: 0.1^16 is a normal number yet


def score_windows(
    image: NDArray[np.float32],
    places: NDArray[np.int32],
    counts: NDArray[np.int32],
    basis: NDArray[np.float32],
    group: NDArray[np.int32],
    origin: NDArray[np.int64],
    likelihood: bool,
    grids: NDArray[np.float32],
    chance: float = 1.0,
) -> None:
    """Add every window's score at all shifts to its group's grid.

    The score is d_D^2 + w d_I^2, with d the image's components along the columns of the basis, over
    the image's own variation. The sign of depth in an image is unknown, that of intensity likely:
    w is 1, or OPPOSITE if d_I < 0. It is a share r of explained variance, above that of an
    unrelated window, or (likelihood) the -log(1 - r) of a Gaussian window. Shifts at which a window
    leaves the image count 0.

    Args:
        image: (h, w).
        places: (n, l, 2) nearest pixels (u, v) at shift 0.
        counts: (n,) how many of them are in use: the first ones.
        basis: (n, l, 4), of which the last two columns are zero where ``likelihood``.
        group: (n,), not falling.
        origin: (2,) the first shift (u, v) of the grids.
        likelihood: of the kind of score.
        grids: (g, s, s).
        chance: how much of an unrelated window's share to subtract.
    """
    height, width = image.shape
    pixels = np.zeros((2, height * width + LANES), np.float32)  # whole image, patch
    pixels[0, : height * width] = (image - image.mean()).ravel()
    sums = tuple(np.empty(max(MAX_SUMS, width) + LANES, np.float32) for _ in range(6))
    factors = np.ones(grids.shape[1:], np.float32)
    _score_windows(
        image.shape, (*pixels,), (places, counts, basis, group), origin, likelihood, sums, factors,
        grids, (chance * CHANCE_DEPTH, chance * CHANCE_INTENSITY),
    )  # fmt: skip


@compiled(fastmath=True)
def _score_windows(shape, pixels, windows, origin, likelihood, sums, factors, grids, shares):  # type: ignore[no-untyped-def]
    """See :func:`score_windows`; sums and factors: room for intermediate values."""
    height, width = shape
    whole, patch = pixels
    places, counts, basis, group = windows
    rows, columns = grids.shape[1], grids.shape[2]
    start = np.empty(places.shape[1], np.int64)
    multiplied = 0
    for w in range(len(places)):
        n = counts[w]
        if multiplied == FACTORS or (multiplied > 0 and group[w] != group[w - 1]):
            _take_logarithms(factors, grids[group[w - 1]])
            multiplied = 0
        left, right, top, bottom = _find_extent(places[w], n)
        first, above = max(origin[0], -left), max(origin[1], -top)
        size = min(origin[0] + columns, width - right) - first
        end = min(origin[1] + rows, height - bottom)
        if size <= 0 or end <= above:
            continue
        source, stride, at_once = whole, width, 1
        corner = (top + above) * width + left + first
        if size >= MIN_PATCH_SHARE * (right - left + size):
            source, stride = patch, right - left + size
            at_once = max(1, MAX_SUMS // stride)
            for row in range(bottom - top + end - above):
                for k in range(stride):
                    patch[row * stride + k] = whole[corner + row * width + k]
            corner = 0
        chance = 0.0
        for p in range(n):
            chance += shares[0] * basis[w, p, 0] ** 2 + shares[1] * basis[w, p, 1] ** 2
            start[p] = corner + (places[w, p, 1] - top) * stride + places[w, p, 0] - left
        for shift in range(above, end, at_once):
            lines = min(at_once, end - shift)
            length = ((lines - 1) * stride + size + LANES - 1) // LANES * LANES
            part = source[(shift - above) * stride :]
            _sum_products(part, start, n, basis[w], not likelihood, length, sums)
            for line in range(lines):
                row, column = shift + line - origin[1], first - origin[0]
                if likelihood:
                    out = factors[row, column : column + size]
                    _multiply_factors(sums, line * stride, n, np.float32(chance), out)
                else:
                    out = grids[group[w], row, column : column + size]
                    _add_shares(sums, line * stride, n, np.float32(chance), out)
        multiplied += int(likelihood)
    if multiplied:
        _take_logarithms(factors, grids[group[-1]])


@compiled()
def _find_extent(places, n):  # type: ignore[no-untyped-def]
    """The least and largest u, then v, of the first n places."""
    left, top = places[0, 0], places[0, 1]
    right, bottom = left, top
    for p in range(1, n):
        left, right = min(left, places[p, 0]), max(right, places[p, 0])
        top, bottom = min(top, places[p, 1]), max(bottom, places[p, 1])
    return left, right, top, bottom


@compiled(fastmath=True)
def _sum_products(pixels, start, n, basis, with_trend, length, sums):  # type: ignore[no-untyped-def]
    """Over a window's points, at each shift k: sums of basis[p] v, of v and of v^2.

    v = pixels[start[p] + k], k < length.
    """
    depth, intensity, total, power, trend_u, trend_v = sums
    noise = np.float32(n * GRAY_NOISE**2)
    for k in range(length):
        depth[k] = 0
        intensity[k] = 0
        total[k] = 0
        power[k] = noise
    if with_trend:
        for k in range(length):
            trend_u[k] = 0
            trend_v[k] = 0
    for p in range(0, n - 4, 5):
        row0, row1, row2 = pixels[start[p] :], pixels[start[p + 1] :], pixels[start[p + 2] :]
        row3, row4 = pixels[start[p + 3] :], pixels[start[p + 4] :]
        p1, p2, p3, p4 = p + 1, p + 2, p + 3, p + 4
        a0, b0, c0, d0 = basis[p, 0], basis[p, 1], basis[p, 2], basis[p, 3]
        a1, b1, c1, d1 = basis[p1, 0], basis[p1, 1], basis[p1, 2], basis[p1, 3]
        a2, b2, c2, d2 = basis[p2, 0], basis[p2, 1], basis[p2, 2], basis[p2, 3]
        a3, b3, c3, d3 = basis[p3, 0], basis[p3, 1], basis[p3, 2], basis[p3, 3]
        a4, b4, c4, d4 = basis[p4, 0], basis[p4, 1], basis[p4, 2], basis[p4, 3]
        for k in range(length):
            v0, v1, v2, v3, v4 = row0[k], row1[k], row2[k], row3[k], row4[k]
            depth[k] += a0 * v0 + a1 * v1 + a2 * v2 + a3 * v3 + a4 * v4
            intensity[k] += b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3 + b4 * v4
            total[k] += v0 + v1 + v2 + v3 + v4
            power[k] += v0 * v0 + v1 * v1 + v2 * v2 + v3 * v3 + v4 * v4
        if with_trend:
            for k in range(length):
                v0, v1, v2, v3, v4 = row0[k], row1[k], row2[k], row3[k], row4[k]
                trend_u[k] += c0 * v0 + c1 * v1 + c2 * v2 + c3 * v3 + c4 * v4
                trend_v[k] += d0 * v0 + d1 * v1 + d2 * v2 + d3 * v3 + d4 * v4
    for p in range(n - n % 5, n):
        row0 = pixels[start[p] :]
        a0, b0, c0, d0 = basis[p, 0], basis[p, 1], basis[p, 2], basis[p, 3]
        for k in range(length):
            v0 = row0[k]
            depth[k] += a0 * v0
            intensity[k] += b0 * v0
            total[k] += v0
            power[k] += v0 * v0
        if with_trend:
            for k in range(length):
                v0 = row0[k]
                trend_u[k] += c0 * v0
                trend_v[k] += d0 * v0


@compiled(fastmath=True)
def _add_shares(sums, at, n, chance, grid):  # type: ignore[no-untyped-def]
    """Add the share of explained variance at each shift of a row."""
    depth, intensity, total, power = sums[0][at:], sums[1][at:], sums[2][at:], sums[3][at:]
    trend_u, trend_v = sums[4][at:], sums[5][at:]
    by_chance = chance * np.float32(n * GRAY_NOISE**2)
    for k in range(len(grid)):
        variation = power[k] - total[k] * total[k] / np.float32(n)
        variation -= trend_u[k] * trend_u[k] + trend_v[k] * trend_v[k]
        explained = depth[k] * depth[k]
        explained += intensity[k] * max(intensity[k], OPPOSITE * intensity[k])
        grid[k] += (explained + by_chance) / variation - chance


@compiled(fastmath=True)
def _multiply_factors(sums, at, n, chance, factors):  # type: ignore[no-untyped-def]
    """Multiply by the residual share at each shift of a row."""
    depth, intensity, total, power = sums[0][at:], sums[1][at:], sums[2][at:], sums[3][at:]
    by_chance = chance * np.float32(n * GRAY_NOISE**2)
    for k in range(len(factors)):
        variation = power[k] - total[k] * total[k] / np.float32(n)
        explained = depth[k] * depth[k]
        explained += intensity[k] * max(intensity[k], OPPOSITE * intensity[k])
        share = (explained + by_chance) / variation - chance
        factors[k] *= np.float32(1) - share / np.float32(1 + MIN_RESIDUAL_SHARE)


@compiled(fastmath=True)
def _take_logarithms(factors, grid):  # type: ignore[no-untyped-def]
    """Subtract the logarithms of the factors from a grid; the factors become 1."""
    for row in range(grid.shape[0]):
        for column in range(grid.shape[1]):
            grid[row, column] -= np.log(factors[row, column])
            factors[row, column] = 1
