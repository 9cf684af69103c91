"""Clouds in .bin files without a header: rows of float32, in columns that rig or content tells.

With the right number of columns, each column has its own distribution: heights are few metres,
intensities have a scale of their own. With a wrong number every column mixes them all.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.point_fields import RawCloud, make_cloud, raw_cloud
from calibgraph.model.correspondences import MAX_COORDINATE

_NAMES = ("x", "y", "z", "intensity", "column 5", "column 6")
_FEW, _MOST = 840, 60_000
"""Of numbers: with fewer, columns are as the name says; so many are looked at."""
_ENOUGH = 0.95
"""Of the largest variance: twice as many columns explain as much, half as many at most 0.91."""
_CLEARLY = 10.0
"""Times the variance between parts of a file: 130 and more if transposed, 1.1 in others."""
_ASK = "write `cloud_columns: [x, y, z, intensity, ring]` into rig.yaml, a name per float32 column"


def read_bin(path: Path, columns: Sequence[str] | None = None) -> RawCloud:
    """The points of a file of float32: of named columns, KITTI's 4, nuScenes' 5 (``.pcd.bin``).

    Raises:
        FileError: if the last row is not whole, or if the content shows other columns than the name
            states, or none.
    """
    data = path.read_bytes()
    if columns is not None:
        rows = _rows(path, data, len(columns))
        return raw_cloud(path, columns, dict(zip(columns, rows.T, strict=True)).__getitem__)
    named = 5 if path.name.lower().endswith(".pcd.bin") else 4
    found = _count_columns(path, np.frombuffer(data, "<f4", len(data) // 4), named)
    if found != named == 5:  # noqa: PLR2004 - of nuScenes
        raise FileError(path, f"holds points of {found} columns by its content, expected nuScenes' "
                        f"5; end its name in .bin alone, or {_ASK}")  # fmt: skip
    told = f"holds points of {found} columns by its content; if they are others, {_ASK}"
    points = make_cloud(*_rows(path, data, found)[:, :4].T)
    return RawCloud(points, _NAMES[:found], told * (found != named))


def _rows(path: Path, data: bytes, columns: int) -> NDArray[np.float32]:
    if len(data) % (4 * columns):
        raise FileError(path, f"{len(data)} bytes is not a whole number of points of {columns} "
                        f"float32; is it complete? If it has other columns, {_ASK}")  # fmt: skip
    return np.frombuffer(data, "<f4").reshape(-1, columns)


def _count_columns(path: Path, values: NDArray[np.float32], named: int) -> int:
    """The named number of columns if it explains as much as any, or else the smallest that does."""
    from scipy.stats import rankdata  # which takes 0.4 s

    if len(values) < _FEW:
        return named
    ranks = rankdata(np.abs(np.nan_to_num(values[:_MOST]))) / min(len(values), _MOST)
    explained = {
        c: float(ranks[: len(ranks) // c * c].reshape(-1, c).mean(axis=0).var())
        - c / (12 * len(ranks))  # what columns that are alike have by chance
        for c in (3, 4, 5, 6)
    }
    thinned = np.abs(np.nan_to_num(values[:: 1 + len(values) // _MOST]))
    parts = np.array_split(rankdata(thinned) / len(thinned), 4)
    between = float(np.var([part.mean() for part in parts]))
    most = max(*explained.values(), 1 / len(ranks))
    if between > _CLEARLY * most:
        raise FileError(
            path, "has all x first, then all y, by its content; write it point by point"
        )
    likely = [c for c in explained if explained[c] >= _ENOUGH * most - 4 / len(ranks)]
    best = named if named in likely or not likely else likely[0]
    rows = values[: len(values) // best * best].reshape(-1, best)[:, :3]
    with np.errstate(invalid="ignore"):
        implausible = bool((np.abs(rows) > MAX_COORDINATE).any())
    if implausible or not values.view(np.uint32)[::2].any():  # random, or float64 of few digits
        raise FileError(path, f"its columns cannot be told by its content: {_ASK}")
    return best
