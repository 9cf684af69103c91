"""The kernel that scores windows against an image at every shift of a grid.

Where the time of a calibration goes. What makes it fast, measured against a matrix product by
``benchmarks.speed.kernel``: the sums over a window's points are taken for a block of shifts at
once, in registers, so that a pixel is loaded for all products that it is in, and no sum is loaded
or stored in between. The image has zero mean, which keeps single precision: its sum of squares is
then not the difference of two large numbers.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.registers import (
    LANES,
    ROWS,
    fill_block,
    load_block,
    store_block,
)
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
UNCOUNTED = {"_nrt": False}  # arrays of callers: to count references takes as long as short loops


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
    pixels = np.zeros((height + ROWS, width + LANES), np.float32)  # blocks may begin anywhere
    pixels[:height, :width] = image - image.mean()
    rows, columns = grids.shape[1:]
    padded = math.ceil(columns / LANES) * LANES
    room = (
        np.empty(places.shape[1], np.int64),
        np.empty(ROWS * padded, np.float32),
        np.full((rows + ROWS) * padded, likelihood, np.float32),
    )
    _score_windows(
        pixels.ravel(), (height, width), (places, counts, basis, group), origin, likelihood, room,
        grids, (chance * CHANCE_DEPTH, chance * CHANCE_INTENSITY),
    )  # fmt: skip


@compiled(fastmath=True, **UNCOUNTED)
def _score_windows(pixels, shape, windows, origin, likelihood, room, grids, by_chance):  # type: ignore[no-untyped-def]
    """See :func:`score_windows`.

    room: for the place in pixels of each point of a window, the scores of a row of blocks, and the
    scores of a group, in rows as long as whole blocks; of likelihoods they are factors.
    """
    height, width = shape
    places, counts, basis, group = windows
    start, scores, totals = room
    stride, padded = width + LANES, len(scores) // ROWS
    rows, columns = grids.shape[1], grids.shape[2]
    held = 0  # windows whose scores are in the totals
    for w in range(len(places)):
        n = counts[w]
        if held > 0 and (group[w] != group[w - 1] or (likelihood and held == FACTORS)):
            _take_totals(totals, padded, likelihood, grids[group[w - 1]])
            held = 0
        held += 1
        left, right, top, bottom = _find_extent(places[w], n)
        first, above = max(origin[0], -left), max(origin[1], -top)
        size = min(origin[0] + columns, width - right) - first
        end = min(origin[1] + rows, height - bottom)
        chance = 0.0
        for p in range(n):
            chance += by_chance[0] * basis[w, p, 0] ** 2 + by_chance[1] * basis[w, p, 1] ** 2
            start[p] = (places[w, p, 1] + above) * stride + places[w, p, 0] + first
        for shift in range(above, end, ROWS):
            for k in range(0, size, LANES):
                at = (shift - above) * stride + k
                score = _score_block(pixels, start, at, stride, n, basis[w], chance, likelihood)
                store_block(scores, k, padded, score)
            at = (shift - origin[1]) * padded + first - origin[0]
            length = size if size < columns else padded  # of whole vectors where it can be
            _add_scores(scores, padded, min(ROWS, end - shift), length, likelihood, totals[at:])
    if held:
        _take_totals(totals, padded, likelihood, grids[group[-1]])


@compiled(**UNCOUNTED)
def _find_extent(places, n):  # type: ignore[no-untyped-def]
    """The least and largest u, then v, of the first n places."""
    left, top = places[0, 0], places[0, 1]
    right, bottom = left, top
    for p in range(1, n):
        left, right = min(left, places[p, 0]), max(right, places[p, 0])
        top, bottom = min(top, places[p, 1]), max(bottom, places[p, 1])
    return left, right, top, bottom


@compiled(fastmath=True, **UNCOUNTED)
def _score_block(pixels, start, at, stride, n, basis, chance, likelihood):  # type: ignore[no-untyped-def]
    """The score of a window of n points at a block of shifts; of a likelihood, the factor.

    At the first of the shifts, point p lies at pixels[start[p] + at].
    """
    noise = n * GRAY_NOISE**2
    depth, intensity, total = fill_block(0.0), fill_block(0.0), fill_block(0.0)
    variation = fill_block(noise)
    for p in range(n):
        seen = load_block(pixels, start[p] + at, stride)
        depth += basis[p, 0] * seen
        intensity += basis[p, 1] * seen
        total += seen
        variation += seen * seen
    variation -= total * total * (1.0 / n)
    explained = depth * depth + intensity * max(intensity, OPPOSITE * intensity)
    if likelihood:
        share = (explained + chance * noise) / variation - chance
        return 1.0 - share * (1 / (1 + MIN_RESIDUAL_SHARE))
    trend_u, trend_v = fill_block(0.0), fill_block(0.0)
    for p in range(n):
        seen = load_block(pixels, start[p] + at, stride)
        trend_u += basis[p, 2] * seen
        trend_v += basis[p, 3] * seen
    variation -= trend_u * trend_u + trend_v * trend_v
    return (explained + chance * noise) / variation - chance


@compiled(fastmath=True, **UNCOUNTED)
def _add_scores(scores, padded, lines, size, likelihood, totals):  # type: ignore[no-untyped-def]
    """Add lines of scores to the totals, or multiply factors."""
    for line in range(lines):
        of_line, out = scores[line * padded :], totals[line * padded :]
        if likelihood:
            for k in range(size):
                out[k] *= of_line[k]
        else:
            for k in range(size):
                out[k] += of_line[k]


@compiled(fastmath=True, **UNCOUNTED)
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
