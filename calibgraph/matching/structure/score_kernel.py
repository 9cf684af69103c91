"""The kernel that scores windows against an image at every shift of a grid.

Where the time of a calibration goes. What makes it fast, measured against a matrix product by
``benchmarks.speed.gate``: the shifts are taken in strips, a vector wide, whose sums stay in the
first-level cache, and the points four at a time, so that a sum is loaded and stored once for all of
them. The image has zero mean, which keeps single precision: its sum of squares is then not the
difference of two large numbers.

All loops over a strip have constant bounds and unsigned indices, which LLVM vectorizes without
remainders, and only as long as their values fit the 32 registers: hence the numbers below.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.memory import mmap_zeros
from factors.compiled import compiled

GRAY_NOISE = 0.05  # of the logarithm of gray: below, a window counts as flat in the image
MIN_RESIDUAL_SHARE = 0.1  # of an image's variance, which no cloud explains
OPPOSITE = np.float32(0.5)
"""Weight of an image that is dark where the intensity is high. Leaves are bright in the near
infrared, and markings are bright in both: on recordings with much of the former, a weight of -1
cost a third of the z-score and up to 50 cm, with much of the latter, 1 cost a tenth."""
CHANCE_DEPTH, CHANCE_INTENSITY = 0.13, 0.05
"""Shares of a structured image's variation that an unrelated window explains. Without them,
windows would rather lie on any structure than on the flat image that they belong to."""
FACTORS = 16  # multiplied before a logarithm is taken: 0.1^16 is a normal number yet
LANES, LINES = 16, 48  # columns and rows of shifts in a strip
POINTS = 4  # added at once
SUMS, SUMS_WITH_TREND = 4, 6  # of each shift
_TO_FACTOR = np.float32(1 / (1 + MIN_RESIDUAL_SHARE))
_index = np.uint64  # numba tests other integers for negative ones


def pad(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """(h + LINES, w + LANES) an image with zero mean, and zeros: strips may begin anywhere."""
    height, width = image.shape
    padded: NDArray[np.float32] = mmap_zeros((height + LINES, width + LANES), np.float32)
    np.subtract(image, image.mean(), out=padded[:height, :width])
    return padded


def score_windows(
    padded: NDArray[np.float32],
    places: NDArray[np.int32],
    counts: NDArray[np.int32],
    basis: NDArray[np.float32],
    group: NDArray[np.int32],
    origin: NDArray[np.int64],
    likelihood: bool,
    grids: NDArray[np.float32],
    chance: float = 1.0,
) -> NDArray[np.float32]:
    """Add every window's score at all shifts to its group's grid.

    The score is d_D^2 + w d_I^2, with d the image's components along the columns of the basis, over
    the image's own variation. The sign of depth in an image is unknown, that of intensity likely:
    w is 1, or OPPOSITE if d_I < 0. It is a share r of explained variance, above that of an
    unrelated window, or (likelihood) the -log(1 - r) of a Gaussian window. Shifts at which a window
    leaves the image count 0.

    Args:
        padded: (h + LINES, w + LANES) an image, see :func:`pad`.
        places: (n, l, 2) nearest pixels (u, v) at shift 0.
        counts: (n,) how many of them are in use: the first ones.
        basis: (n, l, 4), of which the last two columns are zero where ``likelihood``.
        group: (n,), not falling.
        origin: (2,) the first shift (u, v) of the grids.
        likelihood: of the kind of score.
        grids: (g, s, s).
        chance: how much of an unrelated window's share to subtract.

    Returns:
        (g, s, s) of likelihoods: how many of the windows are in the image; else (0, s, s).
    """
    height, width = padded.shape[0] - LINES, padded.shape[1] - LANES
    rows, columns = grids.shape[1:]
    ones = _aligned(2 * LANES)
    ones[:LANES] = 1
    totals = _aligned(rows * math.ceil(columns / LANES) * LANES + LANES)
    totals[:] = likelihood
    inside = np.zeros((len(grids) if likelihood else 0, rows, columns), np.float32)
    room = (
        np.empty(places.shape[1] + POINTS, np.int64),
        _aligned(LINES * SUMS_WITH_TREND * LANES),
        ones,
        totals,
    )
    windows = places, np.ascontiguousarray(counts), np.ascontiguousarray(basis), group
    _score_windows(
        padded.ravel(), (height, width), windows, origin, likelihood, room,
        grids, inside, (np.float32(chance * CHANCE_DEPTH), np.float32(chance * CHANCE_INTENSITY)),
    )  # fmt: skip
    return inside


def _aligned(size: int) -> NDArray[np.float32]:
    """Zeros that begin where a vector does: others take half as long again to load and store."""
    room = np.zeros(size + LANES, np.float32)
    first = -(room.ctypes.data // room.itemsize) % LANES
    return room[first : first + size]


@compiled(fastmath=True)
def _score_windows(  # type: ignore[no-untyped-def]  # noqa: PLR0912 - one pass
    pixels, shape, windows, origin, likelihood, room, grids, counted, by_chance
):
    """See :func:`score_windows`.

    room: for the place in pixels of each point of a window; zeros for the sums of a strip; a vector
    of ones and one of zeros; and for the scores of a group, of likelihoods the factors, in rows of
    whole vectors.
    """
    (height, width), (places, counts, basis, group) = shape, windows
    starts, sums, ones, totals = room
    stride, rows, columns = width + LANES, grids.shape[1], grids.shape[2]
    padded = (columns + LANES - 1) // LANES * LANES
    held = 0  # windows whose scores are in the totals
    for w in range(len(places)):
        n = counts[w]
        if held > 0 and (group[w] != group[w - 1] or (likelihood and held == FACTORS)):
            _take_totals(totals, padded, likelihood, grids[group[w - 1]])
            held = 0
        held += 1
        left, top = places[w, 0, 0], places[w, 0, 1]
        right, bottom, share = left, top, np.float32(0)
        for p in range(n):
            u, v = places[w, p, 0], places[w, p, 1]
            left, right = u if u < left else left, u if u > right else right
            top, bottom = v if v < top else top, v if v > bottom else bottom
            share += by_chance[0] * basis[w, p, 0] ** 2 + by_chance[1] * basis[w, p, 1] ** 2
        first = -left if -left > origin[0] else origin[0]
        above = -top if -top > origin[1] else origin[1]
        size, end = origin[0] + columns, origin[1] + rows
        size = (width - right if width - right < size else size) - first
        end = height - bottom if height - bottom < end else end
        if likelihood:
            for row in range(above - origin[1], end - origin[1]):
                for column in range(first - origin[0], first - origin[0] + size):
                    counted[group[w], row, column] += 1
        numbers = np.float32(1 / n), np.float32(n * GRAY_NOISE**2), share
        for p in range(n - 1, n + POINTS):
            starts[p] = height * stride  # zeros, which add nothing
        for column in range(0, size, LANES):
            inside = ones[LANES - (size - column if size - column < LANES else LANES) :]
            for row in range(above, end, LINES):
                corner = row * stride + first + column
                lines = end - row if end - row < LINES else LINES
                for p in range(n - 1):
                    starts[p] = places[w, p, 1] * stride + places[w, p, 0] + corner
                last = pixels[places[w, n - 1, 1] * stride + places[w, n - 1, 0] + corner :]
                out = totals[(row - origin[1]) * padded + first - origin[0] + column :]
                strip = (lines, stride, padded)
                if likelihood:
                    _add_points(pixels, starts, basis[w], n - 1, strip, sums, False)
                    _take_sums(last, basis[w, n - 1], strip, sums, numbers, inside, out, False)
                else:
                    _add_points(pixels, starts, basis[w], n - 1, strip, sums, True)
                    _take_sums(last, basis[w, n - 1], strip, sums, numbers, inside, out, True)
    if held:
        _take_totals(totals, padded, likelihood, grids[group[-1]])


# Parts are inlined: of one that is not, a process that compiles it runs other code than a later
# process, and with fastmath other sums. And so ``with_trend`` is a constant where they are called.
@compiled(part=True, fastmath=True, forceinline=True)
def _add_points(pixels, starts, basis, count, strip, sums, with_trend):  # type: ignore[no-untyped-def]
    """Add points to the sums of a strip: along depth and intensity, plain, squared, and a trend."""
    lines, stride, _ = strip
    width = (SUMS_WITH_TREND if with_trend else SUMS) * LANES
    for p in range(0, count, POINTS):
        s0, s1, s2, s3 = starts[p], starts[p + 1], starts[p + 2], starts[p + 3]
        a0, a1, a2, a3 = basis[p, 0], basis[p + 1, 0], basis[p + 2, 0], basis[p + 3, 0]
        b0, b1, b2, b3 = basis[p, 1], basis[p + 1, 1], basis[p + 2, 1], basis[p + 3, 1]
        c0, c1, c2, c3 = basis[p, 2], basis[p + 1, 2], basis[p + 2, 2], basis[p + 3, 2]
        d0, d1, d2, d3 = basis[p, 3], basis[p + 1, 3], basis[p + 2, 3], basis[p + 3, 3]
        for line in range(lines):
            for k in range(LANES):
                at, m = line * stride + k, line * width + k
                x0, x1 = pixels[_index(s0 + at)], pixels[_index(s1 + at)]
                x2, x3 = pixels[_index(s2 + at)], pixels[_index(s3 + at)]
                sums[_index(m)] += a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3
                sums[_index(m + LANES)] += b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3
                sums[_index(m + 2 * LANES)] += x0 + x1 + x2 + x3
                sums[_index(m + 3 * LANES)] += x0 * x0 + x1 * x1 + x2 * x2 + x3 * x3
                if with_trend:
                    sums[_index(m + 4 * LANES)] += c0 * x0 + c1 * x1 + c2 * x2 + c3 * x3
                    sums[_index(m + 5 * LANES)] += d0 * x0 + d1 * x1 + d2 * x2 + d3 * x3


@compiled(part=True, fastmath=True, forceinline=True)
def _take_sums(pixels, basis, strip, sums, numbers, inside, out, with_trend):  # type: ignore[no-untyped-def]
    """Add the last point of a window; add the scores, or multiply the factors; clear the sums."""
    (lines, stride, padded), (over, noise, chance) = strip, numbers
    width = (SUMS_WITH_TREND if with_trend else SUMS) * LANES
    a, b, c, d = basis[0], basis[1], basis[2], basis[3]
    for line in range(lines):
        for k in range(LANES):
            x, m = pixels[_index(line * stride + k)], line * width + k
            depth, intensity = sums[_index(m)] + a * x, sums[_index(m + LANES)] + b * x
            total, square = sums[_index(m + 2 * LANES)] + x, sums[_index(m + 3 * LANES)] + x * x
            sums[_index(m)] = sums[_index(m + LANES)] = 0
            sums[_index(m + 2 * LANES)] = sums[_index(m + 3 * LANES)] = 0
            variation = square - total * total * over + noise
            if with_trend:
                u, v = sums[_index(m + 4 * LANES)] + c * x, sums[_index(m + 5 * LANES)] + d * x
                sums[_index(m + 4 * LANES)] = sums[_index(m + 5 * LANES)] = 0
                variation = variation - u * u - v * v
            explained = depth * depth + intensity * (
                intensity if intensity > 0 else OPPOSITE * intensity
            )
            share = inside[_index(k)] * ((explained + chance * noise) / variation - chance)
            if with_trend:
                out[_index(line * padded + k)] += share
            else:
                out[_index(line * padded + k)] *= np.float32(1) - share * _TO_FACTOR


@compiled(part=True, fastmath=True, forceinline=True)
def _take_totals(totals, padded, likelihood, grid):  # type: ignore[no-untyped-def]
    """Add the totals to a grid, of factors the negative logarithms, and clear them."""
    for row in range(grid.shape[0]):
        of_row = totals[row * padded :]
        if likelihood:
            for column in range(grid.shape[1]):
                grid[row, column] -= np.log(of_row[column])
        else:
            for column in range(grid.shape[1]):
                grid[row, column] += of_row[column]
    totals[:] = np.float32(likelihood)
