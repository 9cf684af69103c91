"""The nearest rays of a ray, among rays that are thinned to one per cell of the sphere.

Thinned rays come by rows of equal elevation, and by azimuth within a row. From a ray outwards, rows
and the rays of a row are visited while they can be nearer than the farthest ray found so far. No
tree has to be built or kept.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from factors.compiled import compiled

_ROUNDING_RAD = 1e-6  # of azimuths in single precision
_SIXTH = 1 / 6  # a division would take as long as all else of a ray
_MONOTONE_RAD = math.sqrt(2.0)  # up to there x - x^3 / 6 rises; it is at most sin x


class NearestRays:
    """The nearest rays of any ray of a thinned cloud.

    Args:
        rays_m: (n, 3) of a cloud.
        rows: (m,) those that were kept, in the order of :func:`.directions.thin`.
        angles: (m, 2) their azimuth and elevation.
        cell_rad: by which they are thinned.
    """

    def __init__(
        self, rays_m: Array, rows: NDArray[np.int32], angles: Array, cell_rad: float
    ) -> None:
        self._rows, self._cell_rad = rows, cell_rad
        x, y, z = rays_m[rows].T
        self._units = np.column_stack([x, y, z]) * (1.0 / np.sqrt(x * x + y * y + z * z))[:, None]
        self._elevation = np.ascontiguousarray(angles[:, 1])
        self._azimuth = angles[:, 0].astype(np.float32)
        row = np.floor(angles[:, 1] / cell_rad).astype(np.int64)
        self._lowest = int(row[0]) if len(row) else 0
        count = int(row[-1]) - self._lowest + 1 if len(row) else 0
        self._starts = np.searchsorted(row - self._lowest, np.arange(count + 1))

    @property
    def nbytes(self) -> int:
        """Size in memory, without the rows."""
        arrays = self._units, self._elevation, self._azimuth, self._starts
        return sum(array.nbytes for array in arrays)

    def of(
        self, centres: NDArray[np.int32], most: int, reach: float
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The nearest rays of some of the m, as far as a chord of the unit sphere reaches.

        Returns:
            (w, most) rows of the cloud, the centre first and in place of missing ones; (w,) how
            many there are.
        """
        members = np.empty((len(centres), most), np.int32)
        counts = np.empty(len(centres), np.int32)
        order = np.argsort(self._azimuth[centres])
        places = self._starts[:-1].copy()
        cloud = self._units, self._rows, self._azimuth, self._starts, places
        grid = self._lowest, self._cell_rad, reach
        _find_nearest(cloud, self._elevation, grid, centres, order, members, counts)
        return members, counts


@compiled()
def _find_nearest(cloud, elevation, grid, centres, order, members, counts):  # type: ignore[no-untyped-def]
    """See :meth:`NearestRays.of`. order: of the centres, by azimuth."""
    (units, rows, _, starts, _), (lowest, cell, reach) = cloud, grid
    squares, direction = np.empty(members.shape[1]), np.empty(4)
    for w in order:
        centre, count = centres[w], np.int64(0)  # a literal 0 has another type
        up = elevation[centre]
        direction[0], direction[1] = units[centre, 0], units[centre, 1]
        direction[2] = units[centre, 2]
        direction[3] = math.sqrt(direction[0] ** 2 + direction[1] ** 2)  # of the elevation, cosine
        for k in range(len(squares)):  # a slice compiles slowly
            squares[k] = reach * reach
        above = math.floor(up / cell) - lowest
        below, both, upwards = above - 1, True, True
        while True:
            row = above if upwards else below
            gap = (row + lowest) * cell - up if upwards else up - (row + 1 + lowest) * cell
            gap -= _ROUNDING_RAD
            if 0 <= row < len(starts) - 1 and _is_within(gap - gap**3 / 24, squares[-1]):
                count = _visit_row(cloud, row, centre, direction, squares, members[w], count)
                above, below = above + upwards, below - (not upwards)
                upwards = upwards != both
            elif both:
                both, upwards = False, not upwards
            else:
                break
        counts[w] = count
        members[w, count:] = rows[centre]


@compiled(part=True, forceinline=True)
def _visit_row(cloud, row, centre, direction, squares, found, count):  # type: ignore[no-untyped-def]
    """Insert the rays of a row that are nearer than the farthest; how many are found by then."""
    units, rows, azimuth, starts, places = cloud
    first, end, own = starts[row], starts[row + 1], azimuth[centre]
    while places[row] < end and azimuth[places[row]] < own:
        places[row] += 1  # never back: centres come by azimuth
    left = end - first
    for side in range(2):
        at = places[row] - side
        for _ in range(left):
            at = first if at == end else end - 1 if at < first else at
            away = abs(azimuth[at] - own)
            away = min(min(away, 2 * math.pi - away) - _ROUNDING_RAD, _MONOTONE_RAD)
            if not _is_within(direction[3] * (away - away**3 * _SIXTH), squares[-1]):
                break
            left -= 1 - side
            x, y = units[at, 0] - direction[0], units[at, 1] - direction[1]
            square = x * x + y * y + (units[at, 2] - direction[2]) ** 2
            if square < squares[-1]:
                count = min(count + 1, len(found))
                place = count - 1
                while place > 0 and squares[place - 1] > square:
                    squares[place], found[place] = squares[place - 1], found[place - 1]
                    place -= 1
                squares[place], found[place] = square, rows[at]
            at += 1 - 2 * side
    return count


@compiled(part=True, forceinline=True)
def _is_within(distance, square):  # type: ignore[no-untyped-def]
    """Whether a lower bound of a chord is below the root of a square; a negative one is."""
    return distance < 0 or distance * distance < square
