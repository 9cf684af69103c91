"""The kernel that scores windows against an image at every shift of a grid.

Where the time of a calibration goes. The sums over a window's points are taken for a row of shifts
at once, and for a few points at once, so that a sum is loaded and stored once for all of them;
``benchmarks.speed.kernel`` compares it with a matrix product. The image has zero mean, which keeps
single precision: its sum of squares is then not the difference of two large numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
_BLOCK, _WIDTH = 16, 128  # shifts of a row that are scored at once
_A, _B, _C, _D, _E = (_WIDTH * np.arange(1, 6)).tolist()


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
    pixels = np.zeros((height, width + _BLOCK), np.float32)  # rows of shifts come in whole blocks
    pixels[:, :width] = image - image.mean()
    room = np.empty(6 * _WIDTH, np.float32)
    totals = np.full(grids.shape[1:], likelihood, np.float32)
    _score_windows(
        pixels.ravel(), image.shape, places, counts, basis, group, origin, likelihood, room, totals,
        grids, (chance * CHANCE_DEPTH, chance * CHANCE_INTENSITY),
    )  # fmt: skip


@compiled(fastmath=True)
def _score_windows(  # type: ignore[no-untyped-def]  # noqa: PLR0913, PLR0917
    pixels, shape, places, counts, basis, group, origin, likelihood, room, totals, grids, by_chance
):
    """See :func:`score_windows`.

    room: for sums; totals: the scores of a group, of likelihoods as factors.
    """
    height, width = shape
    stride = width + _BLOCK
    rows, columns = totals.shape
    start = np.empty(places.shape[1], np.int64)
    held = 0  # windows whose scores are in the totals
    for w in range(len(places)):
        n = counts[w]
        if held > 0 and (group[w] != group[w - 1] or (likelihood and held == FACTORS)):
            _take_totals(totals, likelihood, grids[group[w - 1]])
            held = 0
        held += 1
        left, top = places[w, 0, 0], places[w, 0, 1]
        right, bottom, chance = left, top, np.float32(0)
        for p in range(n):
            u, v = places[w, p, 0], places[w, p, 1]
            left, right = u if u < left else left, u if u > right else right
            top, bottom = v if v < top else top, v if v > bottom else bottom
            chance += by_chance[0] * basis[w, p, 0] ** 2 + by_chance[1] * basis[w, p, 1] ** 2
            start[p] = v * stride + u
        first, end = max(origin[0], -left), min(origin[0] + columns, width - right)
        for shift in range(max(origin[1], -top), min(origin[1] + rows, height - bottom)):
            for k in range(first, end, _WIDTH):
                size = end - k if end - k < _WIDTH else _WIDTH
                blocks = (size + _BLOCK - 1) // _BLOCK
                at = shift * stride + k
                _sum_points(pixels, start, at, n, basis[w], likelihood, blocks, room)
                total = totals[shift - origin[1], k - origin[0] :]
                _add_scores(room, size, n, chance, likelihood, total)
    if held:
        _take_totals(totals, likelihood, grids[group[-1]])


@compiled(fastmath=True)
def _sum_points(pixels, start, at, n, basis, likelihood, blocks, room):  # type: ignore[no-untyped-def]
    """Fill in the sums over a window's points at a row of shifts, some points at a time.

    At the first shift, point p lies at pixels[start[p] + at].
    """
    width = _BLOCK * blocks
    for k in range(width):
        room[k] = room[_A + k] = room[_B + k] = room[_C + k] = room[_D + k] = room[_E + k] = 0
    whole = n - n % 5
    for p in range(0, whole, 5):
        r, s, t = pixels[start[p] + at :], pixels[start[p + 1] + at :], pixels[start[p + 2] + at :]
        q, o = pixels[start[p + 3] + at :], pixels[start[p + 4] + at :]
        b = basis[p:]
        if likelihood:
            for k in range(width):
                v, w, x, y, z = r[k], s[k], t[k], q[k], o[k]
                room[k] += b[0, 0] * v + b[1, 0] * w + b[2, 0] * x + b[3, 0] * y + b[4, 0] * z
                room[_A + k] += b[0, 1] * v + b[1, 1] * w + b[2, 1] * x + b[3, 1] * y + b[4, 1] * z
                room[_B + k] += v + w + x + y + z
                room[_C + k] += v * v + w * w + x * x + y * y + z * z
        else:
            for k in range(width):
                v, w, x, y, z = r[k], s[k], t[k], q[k], o[k]
                room[k] += b[0, 0] * v + b[1, 0] * w + b[2, 0] * x + b[3, 0] * y + b[4, 0] * z
                room[_A + k] += b[0, 1] * v + b[1, 1] * w + b[2, 1] * x + b[3, 1] * y + b[4, 1] * z
                room[_B + k] += v + w + x + y + z
                room[_C + k] += v * v + w * w + x * x + y * y + z * z
                room[_D + k] += b[0, 2] * v + b[1, 2] * w + b[2, 2] * x + b[3, 2] * y + b[4, 2] * z
                room[_E + k] += b[0, 3] * v + b[1, 3] * w + b[2, 3] * x + b[3, 3] * y + b[4, 3] * z
    for p in range(whole, n):
        seen = pixels[start[p] + at :]
        for k in range(width):
            x = seen[k]
            room[k] += basis[p, 0] * x
            room[_A + k] += basis[p, 1] * x
            room[_B + k] += x
            room[_C + k] += x * x
            room[_D + k] += basis[p, 2] * x
            room[_E + k] += basis[p, 3] * x


@compiled(fastmath=True)
def _add_scores(room, width, n, chance, likelihood, totals):  # type: ignore[no-untyped-def]
    """Add the scores of a row of shifts to the totals, or multiply factors."""
    noise, mean = np.float32(n * GRAY_NOISE**2), np.float32(1.0 / n)
    over = np.float32(1 / (1 + MIN_RESIDUAL_SHARE))
    for k in range(width):
        shade, total = room[_A + k], room[_B + k]
        explained = room[k] * room[k] + shade * (shade if shade > 0 else OPPOSITE * shade)
        trend = room[_D + k] * room[_D + k] + room[_E + k] * room[_E + k]
        varied = room[_C + k] + noise - total * total * mean - trend
        room[k] = (explained + chance * noise) / varied - chance
    if likelihood:
        for k in range(width):
            totals[k] *= np.float32(1) - room[k] * over
    else:
        for k in range(width):
            totals[k] += room[k]


@compiled(fastmath=True)
def _take_totals(totals, likelihood, grid):  # type: ignore[no-untyped-def]
    """Add the totals to a grid, of factors the negative logarithms, and clear them."""
    for row in range(grid.shape[0]):
        of_row, out = totals[row], grid[row]
        for column in range(len(out)):
            out[column] += -np.log(of_row[column]) if likelihood else of_row[column]
    totals[:] = np.float32(likelihood)
