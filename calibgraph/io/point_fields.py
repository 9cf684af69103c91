"""Clouds as files hold them: named fields, and which of them are x, y, z and the intensity."""

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.errors import FileError

INTENSITIES = (
    "intensity", "intensities", "reflectivity", "reflectance", "remission", "amplitude", "signal",
    "i",
)  # fmt: skip
"""Names of an intensity in lower case, the first that is there counts."""

_SCALAR = "scalar_"  # CloudCompare's prefix
_MOST_DIGITS = 18  # of a number of 64 bits
_LONGEST_LINE = 2**20


class RawCloud(NamedTuple):
    """The points of a file.

    Attributes:
        points: (n, 4) x y z [m] and intensity, NaN where there is none.
        fields: their names in the file.
        told: in one line, what the content alone tells, where the file does not say it.
    """

    points: NDArray[np.float32]
    fields: tuple[str, ...]
    told: str = ""


@dataclass(frozen=True)
class Field:
    """A field of each point.

    Attributes:
        name: in the file.
        kind: numpy's type of one number, as <f4.
        count: how many numbers it has.
    """

    name: str
    kind: str
    count: int = 1

    @property
    def bytes(self) -> int:
        """In each point."""
        return np.dtype(self.kind).itemsize * self.count


def find_intensity(names: Iterable[str]) -> str | None:
    """The field that is the intensity: in any case, with CloudCompare's prefix or without."""
    plain = {name.lower().removeprefix(_SCALAR): name for name in reversed(list(names))}
    return next((plain[name] for name in INTENSITIES if name in plain), None)


def choose_fields(path: Path | str, names: Sequence[str]) -> list[str]:
    """The fields x, y, z, and the intensity if there is one."""
    chosen = []
    for axis in "xyz":
        found = [name for name in names if name == axis] or [n for n in names if n.lower() == axis]
        if len(found) != 1:
            raise FileError(
                path, f"has the fields {' '.join(names) or '(none)'}, expected one {axis}"
            )
        chosen += found
    intensity = find_intensity(names)
    return chosen if intensity is None else [*chosen, intensity]


def raw_cloud(
    path: Path | str, names: Sequence[str], column: Callable[[str], NDArray[Any]]
) -> RawCloud:
    """The cloud of fields."""
    columns = [column(name) for name in choose_fields(path, names)]
    if any(each.dtype.kind not in "fiu" for each in columns):
        raise FileError(path, "holds no numbers in the fields of its points")
    return RawCloud(make_cloud(*columns), tuple(names))


def make_cloud(
    x: ArrayLike, y: ArrayLike, z: ArrayLike, intensity: ArrayLike | None = None
) -> NDArray[np.float32]:
    """(n, 4) float32 of (n,) coordinates and intensities, NaN if there are none."""
    cloud = np.full((len(np.asarray(x)), 4), np.nan, dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, and is refused as such
        for column, values in enumerate((x, y, z, intensity)):
            if values is not None:
                cloud[:, column] = values
    return cloud


def read_count(word: str) -> int:
    """A number of points, of digits alone: ``int`` takes signs and underscores."""
    if not word.isdecimal() or len(word) > _MOST_DIGITS:
        raise ValueError(f"found {word[:_MOST_DIGITS]!r}, expected a number")
    return int(word)


def _too_long(path: Path, count: int) -> FileError:
    """The error of a file that has more points than its header."""
    return FileError(path, f"goes on after the {count} points of its header; write it again")


def truncated(path: Path, count: int) -> FileError:
    """The error of a file that has fewer points than its header."""
    return FileError(path, f"is truncated: it ends before its {count} points; write it again")


def binary_columns(
    path: Path, body: memoryview, count: int, fields: Sequence[Field]
) -> Iterator[NDArray[Any]]:
    """The first number of each field of points that lie one after the other, without a copy."""
    start, step = 0, sum(each.bytes for each in fields)
    if count * step > len(body):
        raise truncated(path, count)
    if len(body) >= (count + 1) * step:
        raise _too_long(path, count)
    for each in fields:
        yield np.ndarray((count,), each.kind, body, start, (step,))
        start += each.bytes


def read_rows(
    path: Path, body: memoryview, count: int, widths: Sequence[int]
) -> NDArray[np.float64]:
    """(count, width) numbers of the lines that are not blank; overlong ones are cut.

    Args:
        path: of the file.
        body: its text, from the points on.
        count: of points.
        widths: how many numbers a line may have, the same on all.

    Raises:
        FileError: if there are other than as many lines, or they hold something else.
    """
    text = io.TextIOWrapper(io.BytesIO(body), "ascii", "replace", newline="\n")
    lines = (each for each in iter(lambda: text.readline(_LONGEST_LINE), "") if not each.isspace())
    first = next(lines, "")
    if len(first.split()) not in widths:
        raise FileError(
            path, f"its first point has {len(first.split())} numbers, expected {widths[0]}"
        )
    try:
        rows = np.loadtxt(islice(chain([first], lines), count), ndmin=2, comments=None)
    except ValueError as error:
        raise FileError(path, f"holds no points where they should be: {error}") from None
    if len(rows) != count:
        raise FileError(path, f"is truncated: {len(rows)} of its {count} points; write it again")
    if next(lines, None) is not None:
        raise _too_long(path, count)
    return rows
