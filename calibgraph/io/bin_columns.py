"""Clouds in .bin files without a header: how many columns of which numbers, told by their content.

The columns of a cloud differ in their distribution: heights are few metres, intensities have a
scale of their own. With the right number of columns c, the position j mod c of a number in the file
therefore tells about its value: I(value; j mod c), their mutual information, is large. With a wrong
number every position mixes the columns, and it is zero, or smaller where the numbers share a
divisor. The order of the points does not matter.
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.point_fields import RawCloud, make_cloud
from calibgraph.model.correspondences import MAX_COORDINATE

_NUSCENES = ".pcd.bin"
_COLUMNS = range(3, 9)
_BINS = 16
_BLOCK, _MOST_BLOCKS = 840, 40
"""Numbers in a row, a multiple of all numbers of columns, and how many such parts are looked at."""
_ENOUGH = 0.65
"""Share of the largest information that the smallest number of columns needs: twice as many columns
have as much. On clouds of 11 LiDARs it is 0.98 and more if the smaller number is right, and at most
0.57 if the larger one is."""
_CLEARLY = 10.0
"""Ratio of information: 80 and more in transposed clouds, at most 1.5 in others."""


class _Layout(NamedTuple):
    """Rows of ``columns`` numbers of a type."""

    dtype: str
    columns: int

    @property
    def names(self) -> tuple[str, ...]:
        """Of the columns, as far as they have any."""
        return ("x", "y", "z", "intensity")[: self.columns]

    def __str__(self) -> str:
        more = f" and {self.columns - len(self.names)} more" * (self.columns > len(self.names))
        return f"{self.columns} {np.dtype(self.dtype).name} ({' '.join(self.names)}{more})"

    @property
    def row_bytes(self) -> int:
        """Of one point."""
        return self.columns * np.dtype(self.dtype).itemsize


def read_bin(path: Path) -> RawCloud:
    """The points of a file of numbers: KITTI's 4 float32, nuScenes' 5 (``.pcd.bin``), others.

    Rows are of 3 to 8 columns, float32 or float64: x, y, z, then an intensity, then others. Clouds
    of under 840 numbers, and those whose columns are alike, are taken to be as their name says.

    Raises:
        FileError: if the content contradicts the name or is transposed, or the last row is not
            whole.
    """
    data = path.read_bytes()
    named = _Layout("<f4", 5 if path.name.lower().endswith(_NUSCENES) else 4)
    found = _layout_of(path, data) or named
    if len(data) % found.row_bytes:
        raise FileError(
            path,
            f"{len(data)} bytes is not a whole number of points of {found}; is it complete?",
        )
    if found != named and path.name.lower().endswith(_NUSCENES):
        raise FileError(
            path,
            f"holds points of {found} by its content, expected those of nuScenes, {named}; end its "
            "name in .bin alone",
        )
    rows = np.frombuffer(data, found.dtype).reshape(-1, found.columns)
    told = f"holds points of {found} by its content" * (found != named)
    return RawCloud(make_cloud(*rows[:, :4].T), found.names, told)


def _layout_of(path: Path, data: bytes) -> _Layout | None:
    """The layout that the content shows, None if it shows none."""
    for dtype in ("<f4", "<f8"):
        values = np.frombuffer(data, dtype, len(data) // np.dtype(dtype).itemsize)
        if dtype == "<f4" and not values.view(np.uint32)[::2].any():
            continue  # float64 of few digits
        columns = _count_columns(path, values)
        if columns and _are_coordinates(values, columns):
            return _Layout(dtype, columns)
    return None


def _count_columns(path: Path, values: NDArray[Any]) -> int | None:
    """The smallest number of columns that tells as much as any; None if none is significant."""
    blocks = values[: len(values) // _BLOCK * _BLOCK].reshape(-1, _BLOCK)
    values = blocks[:: max(1, len(blocks) // _MOST_BLOCKS)].ravel()
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return None
    edges = np.unique(ordered[np.arange(1, _BINS) * len(ordered) // _BINS])
    bins, places = np.searchsorted(edges, values), np.arange(len(values))
    by_row = {c: _information(bins, places % c, c) for c in _COLUMNS}
    most = max(by_row.values())
    by_column = max(_information(bins, places * c // len(places), c) for c in (3, 4))
    if by_column > _CLEARLY * most:
        raise FileError(
            path, "has all x first, then all y, by its content; write it point after point"
        )
    return next((c for c in _COLUMNS if by_row[c] >= _ENOUGH * most), None) if most > 0 else None


def _information(bins: NDArray[np.intp], columns: NDArray[np.intp], count: int) -> float:
    """I(bin; column) [nat], 0 if it is not significant by the Bayesian information criterion."""
    width = int(bins.max()) + 1
    table = np.bincount(columns * width + bins, minlength=count * width).reshape(count, width)
    shares = table / len(bins)
    chance = shares.sum(axis=1, keepdims=True) * shares.sum(axis=0)
    there = shares > 0
    information = float(np.sum(shares[there] * np.log(shares[there] / chance[there])))
    free = (width - 1) * (count - 1)
    penalty = free * math.log(len(bins)) / (2 * len(bins))
    return information - free / (2 * len(bins)) if information > penalty else 0.0


def _are_coordinates(values: NDArray[Any], columns: int) -> bool:
    """Whether the first three columns are coordinates, or NaN."""
    xyz = values[: len(values) // columns * columns].reshape(-1, columns)[:, :3]
    with np.errstate(invalid="ignore"):
        return not np.any(np.abs(xyz) > MAX_COORDINATE)
