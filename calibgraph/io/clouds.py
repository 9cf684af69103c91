"""Clouds from disk: named fields in .npy, .bin, .pcd, .ply and .feather files; notes on them."""

import io
import math
import re
import struct
import threading
import tokenize
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibgraph.errors import DatasetError, FileError, in_words
from calibgraph.files import require_file
from calibgraph.io.argoverse_lidars import SUFFIXES, file_of, read_lidar
from calibgraph.io.tables import read_feather
from calibgraph.model.correspondences import MAX_COORDINATE
from factors.compiled import compiled

INTENSITIES = (
    "intensity", "intensities", "reflectivity", "reflectance", "remission", "amplitude", "signal",
    "i",
)  # fmt: skip
"""Names of an intensity in lower case, the first that is there counts."""

TIMES = ("t", "time", "timestamp", "offset_time", "time_offset", "time_stamp")
"""Names of a point's time: of Ouster, Velodyne, Hesai, Livox, and Autoware."""
_STAMPS, _NANOSECOND_STAMPS = 1e6, 1e15  # times since a scan's start are smaller, since 1970 larger
_LONGEST_S = 1.0

_SCALAR = "scalar_"  # CloudCompare's prefix
_MOST_DIGITS = 18  # of a number of 64 bits
_LONGEST_LINE = 2**20


class RawCloud(NamedTuple):
    """The points of a file.

    Attributes:
        points: (n, 4) x y z [m] and intensity, NaN where there is none.
        fields: their names in the file.
        told: in one line, what the content alone tells, where the file does not say it.
        times: (n,) of the points, as the file has them; None if it has none.
    """

    points: NDArray[np.float32]
    fields: tuple[str, ...]
    told: str = ""
    times: NDArray[Any] | None = None


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
    times = [column(name) for name in time_fields(names)]
    return RawCloud(make_cloud(*columns), tuple(names), times=times[0] if times else None)


def time_fields(names: Iterable[str]) -> list[str]:
    """The fields that give each point a time: such clouds are often as they were scanned."""
    return [name for name in names if name in TIMES]


def seconds_after(stamp_ns: int | None, times: NDArray[Any], where: str) -> NDArray[np.float64]:
    """Times of points [s] after a stamp; of stamps after the first, if it is None.

    They are whole numbers of nanoseconds after it (Ouster, Livox), seconds after it (Velodyne), or
    float64 stamps of their own, in seconds (Hesai, RoboSense) or nanoseconds.
    """
    seconds, latest, is_float = (
        times.astype(np.float64),
        times.max(initial=0),
        times.dtype.kind == "f",
    )
    in_ns = latest > _NANOSECOND_STAMPS or not is_float
    if is_float and latest > _STAMPS:
        start_ns = int(seconds.min() * (1 if in_ns else 1e9)) if stamp_ns is None else stamp_ns
        whole, part = (start_ns, 0.0) if in_ns else (start_ns // 10**9, start_ns % 10**9 / 1e9)
        seconds = seconds - whole - part
    seconds = seconds / 1e9 if in_ns else seconds
    if not np.all(np.abs(seconds) <= _LONGEST_S):  # not finite, too
        raise DatasetError(
            f"{where}: times from {np.min(seconds):.3g} to {np.max(seconds):.3g} s after the "
            "stamp are not those of one scan; leave the motion out (--motion, poses.csv), or "
            "record it again"
        )
    return seconds


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


class Layout(NamedTuple):
    """The number of points in a file, the names of their fields, and their type."""

    points: int
    names: Sequence[str]
    kind: np.dtype[Any]


def binary_columns(path: Path, body: memoryview, layout: Layout) -> list[NDArray[Any]]:
    """Each field of points that lie one after the other, without a copy."""
    count, size = layout.points, layout.kind.itemsize
    if count * size > len(body):
        raise truncated(path, count)
    if len(body) >= (count + 1) * size:
        raise _too_long(path, count)
    points = np.frombuffer(body, layout.kind, count)
    return [points[name] for name in points.dtype.names or ()]


def read_rows(
    path: Path, body: memoryview, count: int, widths: Sequence[int]
) -> NDArray[np.float64]:
    """(count, width) numbers of the lines that are not blank, of one of the widths."""
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


_HEADER_BYTES = 65536
_DATA = re.compile(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE)
_SIZES = struct.Struct("<II")  # compressed and uncompressed
_PCD_KINDS = {f"{letter}{size}" for letter in "IU" for size in (1, 2, 4, 8)} | {"F2", "F4", "F8"}
_PADDING = "_"
_MOST_BYTES = 2 * 2**30  # unpacked
_MOST_NUMBERS = 10**8  # of a field: numpy's types have no more bytes, and no file has so many


def read_pcd(path: Path) -> RawCloud:
    """The points of a file, in the frame of the sensor, as they are stored.

    Fields may be of any type and count; those named ``_`` are padding. ``VIEWPOINT`` is the pose of
    the sensor in the world when it recorded the cloud. It is not applied, as PCL does not either:
    points of one sensor stay in its frame.
    """
    data = path.read_bytes()
    end = _DATA.search(data[:_HEADER_BYTES])
    if end is None:
        raise FileError(path, "has no complete .pcd header; is it complete?")
    layout = _pcd_layout(path, data[: end.start()].decode("ascii", "replace"))
    body, encoding = memoryview(data)[end.end() :], end[1].lower()
    if encoding not in _DATA_READERS:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    single = {
        name: k for k, name in enumerate(layout.names)
        if not layout.kind[k].shape and name != _PADDING
    }  # fmt: skip
    choose_fields(path, [*single])  # before points are read as if they were right
    columns = _DATA_READERS[encoding](path, body, layout)
    return raw_cloud(path, [*single], lambda name: columns[single[name]])


def _pcd_layout(path: Path, header: str) -> Layout:
    lines = {words[0]: words[1:] for words in map(str.split, header.split("\n")) if words}
    try:
        names = lines.get("FIELDS") or lines["COLUMNS"]
        counts = [read_count(word) for word in lines.get("COUNT", ["1"] * len(names))]
        kinds = [a + b for a, b in zip(lines["TYPE"], lines["SIZE"], strict=True)]
        each = [*zip(names, kinds, counts, strict=True)]
        sides = [read_count(lines[side][0]) for side in ("WIDTH", "HEIGHT") if side in lines]
        points = read_count(lines["POINTS"][0]) if "POINTS" in lines else sides[0] * sides[1]
    except (KeyError, IndexError, ValueError) as error:
        raise FileError(path, f"has a malformed PCD header ({error})") from None
    whole = not sides or points == sides[0] * sides[-1] * (len(sides) > 1)
    if not whole or min(counts) < 1 or not set(kinds) <= _PCD_KINDS:
        raise FileError(path, "has a malformed PCD header: its FIELDS, SIZE, TYPE and COUNT, or "
                        "its WIDTH, HEIGHT and POINTS do not fit")  # fmt: skip
    if not points:
        raise FileError(path, "holds no point")
    types = [("", f"<{kind.lower()}", (min(n, _MOST_NUMBERS),) * (n > 1)) for _, kind, n in each]
    return Layout(points, names, np.dtype(types))


def _ascii_columns(path: Path, body: memoryview, layout: Layout) -> list[NDArray[Any]]:
    """The first number of each field; padding may be left out of the lines."""
    full = [math.prod(layout.kind[k].shape) for k in range(len(layout.names))]
    short = [n * (name != _PADDING) for name, n in zip(layout.names, full, strict=True)]
    rows = read_rows(path, body, layout.points, [sum(full), sum(short)])
    starts = np.cumsum([0, *(full if rows.shape[1] == sum(full) else short)])
    return [rows[:, start : start + 1].ravel() for start in starts[:-1]]


def _compressed_columns(path: Path, body: memoryview, layout: Layout) -> list[NDArray[Any]]:
    """Each field: the fields lie one after the other, PCL's without padding."""
    count = layout.points
    packed, unpacked = _SIZES.unpack(body[:8]) if len(body) >= _SIZES.size else (1, 0)
    full = [layout.kind[k].itemsize * count for k in range(len(layout.names))]
    short = [n * (name != _PADDING) for name, n in zip(layout.names, full, strict=True)]
    if len(body) < _SIZES.size + packed:
        raise truncated(path, count)
    fits = unpacked in (sum(full), sum(short)) and unpacked <= min(packed * MOST_RATIO, _MOST_BYTES)
    data = np.frombuffer(body, np.uint8, packed, _SIZES.size)
    plain = unpack_lzf(data, unpacked) if fits else None
    if plain is None:
        raise FileError(path, f"its compressed data are not its {count} points; write it again")
    parts = np.split(plain, np.cumsum(full if unpacked == sum(full) else short)[:-1])
    return [part.view(layout.kind[k].base) for k, part in enumerate(parts)]


_DATA_READERS = {
    b"ascii": _ascii_columns, b"binary": binary_columns, b"binary_compressed": _compressed_columns,
}  # fmt: skip


MOST_RATIO = 88
"""Three bytes stand for at most 264."""

_LITERALS, _LONG = 32, 7  # controls below are literal bytes; lengths from here on have a byte more


def unpack_lzf(data: NDArray[np.uint8], size: int) -> NDArray[np.uint8] | None:
    """(size,) the unpacked bytes; None if the data are damaged or unpack to another size."""
    out = np.empty(size, np.uint8)
    try:
        return out if _unpack(data, out) == size else None
    except IndexError:  # they refer beyond it, or end early
        return None


@compiled(boundscheck=True)
def _unpack(data: Any, out: Any) -> int:
    """Fill ``out``; the number of bytes written, -1 if the data refer to what is before it."""
    at, end = 0, 0
    while at < len(data):
        control: Any = np.int64(data[at])
        if control < _LITERALS:
            for k in range(1, control + 2):
                out[end] = data[at + k]
                end += 1
            at += control + 2
            continue
        length = control >> 5
        if length == _LONG:
            at += 1
            length += np.int64(data[at])
        start = end - ((control & 31) << 8) - np.int64(data[at + 1]) - 1
        if start < 0:
            return -1
        for k in range(start, start + length + 2):
            out[end] = out[k]
            end += 1
        at += 2
    return end


_PLY_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_PLY_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


def read_ply(path: Path) -> RawCloud:
    """The vertices of a file."""
    data = path.read_bytes()
    end = _PLY_END.search(data[:_HEADER_BYTES])
    if end is None or not data.startswith(b"ply"):
        raise FileError(path, "has no complete .ply header; is it complete?")
    header = data[: end.start()].decode("ascii", "replace")
    is_text, layout = _ply_layout(path, header)
    choose_fields(path, layout.names)  # before points are read as if they were right
    body = memoryview(data)[end.end() :]
    columns = (
        read_rows(path, body, layout.points, [len(layout.names)]).T if is_text
        else binary_columns(path, body, layout)
    )  # fmt: skip
    return raw_cloud(path, layout.names, lambda name: columns[layout.names.index(name)])


def _ply_layout(path: Path, header: str) -> tuple[bool, Layout]:
    """Whether it is text; the layout of its vertices."""
    order, elements, counts = None, list[str](), dict[str, int]()
    names, kinds = list[str](), list[str]()
    for line in header.split("\n"):
        try:
            match line.split():
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", encoding, _]:
                    order = _ORDERS.get(encoding)
                case ["element", name, number]:
                    elements.append(name)
                    counts[name] = read_count(number)
                case ["property", kind, *words] if words:
                    if elements[-1] == "vertex":
                        names.append(" ".join(words))
                        kinds.append(_PLY_KINDS[kind])
                case _:
                    raise ValueError(line)
        except (KeyError, IndexError, ValueError):
            raise FileError(path, f"has a malformed PLY header, at {line[:200]!r}") from None
    if order is None:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    if elements.count("vertex") != 1:
        raise FileError(path, "has no plain list of vertices in its PLY header")
    if not (count := counts.pop("vertex")):
        raise FileError(path, "holds no point")
    for name in filter(counts.get, counts):
        raise FileError(path, f"holds {name!r} besides its vertices; write it with these alone")
    return not order, Layout(count, names, np.dtype([("", order + kind) for kind in kinds]))


_NAMES = ("x", "y", "z", "intensity", "column 5", "column 6")
_FEW, _MOST = 840, 60_000
"""Of numbers: with fewer, columns are as the name says; so many are looked at."""
_ENOUGH = 0.95
"""Of the largest variance: twice as many columns explain as much, half as many at most 0.91."""
_CLEARLY = 10.0
"""Times the variance between parts of a file: 130 and more if transposed, 1.1 in others."""
_ASK = "write `cloud_columns: [x, y, z, intensity, ring]` into rig.yaml, a name per float32 column"


def read_bin(path: Path, columns: Sequence[str] | None = None) -> RawCloud:
    """The points of a file of float32: of named columns, KITTI's 4, nuScenes' 5 (``.pcd.bin``)."""
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


MAX_CLOUD_BYTES = 2 * 2**30
MOST_POINTS = 400_000
"""Of a cloud that is used: larger ones, which join many scans, take minutes and gigabytes more and
are no more accurate."""

_PARSER = threading.Lock()
"""numpy reads headers by Python's parser, which in 3.11 raises SystemError if another thread parses
in the midst of it."""

_UNREADABLE = (
    ValueError, TypeError, OSError, EOFError, MemoryError, OverflowError, RecursionError,
    SyntaxError, tokenize.TokenError, zipfile.BadZipFile,
)  # fmt: skip
"""Of numpy, which takes the header of a file as Python, and memory for all that it claims."""

_XYZ, _XYZI = 3, 4
_MOST_COLUMNS = 64


def load_cloud(path: Path | str, columns: Sequence[str] | None = None) -> NDArray[np.float32]:
    """Read a cloud.

    Args:
        path: a .npy array (n, 3), (n, 4+) or with named fields, rows of numbers in a .bin (KITTI,
            nuScenes), .pcd, .ply, or a .feather of Argoverse 2.
        columns: names of those of a .bin; told by its content if None.

    Returns:
        (n, 4) x y z [m] in the LiDAR frame and the intensity as the file has it, NaN where it has
        none. Rows whose x, y and z are all NaN or all zero ("no return") are left out.
    """
    return with_intensity(read_returns(Path(path), columns).points)


def thin_cloud(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """At most ``MOST_POINTS`` of a cloud's points, drawn at random, the same each time."""
    if len(cloud) <= MOST_POINTS:
        return cloud
    drawn = np.random.default_rng(0).choice(len(cloud), MOST_POINTS, replace=False)
    return cloud[np.sort(drawn)]


def describe_thinned(sizes: Iterable[int]) -> list[str]:
    """A line if clouds of these sizes have been thinned."""
    full = [size >= MOST_POINTS for size in sizes]
    if not any(full):
        return []
    return [
        f"{sum(full)} of {len(full)} clouds have {MOST_POINTS:,} points or more: "
        f"{MOST_POINTS:,} of each, drawn at random, are used"
    ]


def read_returns(path: Path, columns: Sequence[str] | None = None) -> RawCloud:
    """The points of a file that are returns, and the names of its fields."""
    if (size := require_file(file_of(path)).stat().st_size) > MAX_CLOUD_BYTES:
        raise FileError(path, f"{size} bytes is too large for one cloud")
    if path.suffix.lower() not in _READERS:
        raise FileError(path, f"unknown cloud format; known are {', '.join(CLOUD_SUFFIXES)}")
    is_bin = path.suffix.lower() == ".bin"
    found = read_bin(path, columns) if is_bin else _READERS[path.suffix.lower()](path)
    return only_returns(found, path)


def only_returns(cloud: RawCloud, path: Path | str) -> RawCloud:
    """The points with a return."""
    xyz, (x, y, z) = cloud.points[:, :3], cloud.points[:, :3].T
    measured = ~(np.isnan(x) & np.isnan(y) & np.isnan(z))
    if not measured.any():
        raise FileError(path, "holds no point")
    returned = measured & ((x != 0) | (y != 0) | (z != 0))
    if not returned.any():
        raise FileError(path, f"all of its {measured.sum()} points lie at the origin")
    finite = np.isfinite(xyz)
    if not finite[returned].all():
        row = int(np.flatnonzero(returned & ~finite.all(axis=1))[0])
        raise FileError(
            path,
            f"point {row} is not finite: {xyz[row].tolist()}; record again, or mark points "
            "without a return by NaN in x, y and z",
        )
    with np.errstate(invalid="ignore"):  # random bytes are numbers that warn
        largest = np.abs(xyz).max(where=finite, initial=0.0)
    if largest > MAX_COORDINATE:
        raise FileError(
            path,
            f"holds a coordinate of {largest:.3g}, expected metres, up to {MAX_COORDINATE:g}; "
            "convert its unit, or mark points without a return by NaN in x, y and z",
        )
    if returned.all():
        return cloud
    times = None if cloud.times is None else cloud.times[returned]
    return cloud._replace(points=cloud.points[returned], times=times)


_MOST_MISSING, _MOST_RATIO = 0.1, 1e12


def intensity_fault(cloud: NDArray[np.float32]) -> str:
    """Why the intensities of a cloud (n, 4) are none, as if of another field; empty if they are."""
    values = np.abs(cloud[:, 3])
    finite = values[np.isfinite(values)]
    missing = 1 - len(finite) / max(1, len(values))
    if missing == 1:
        return ""
    if missing > _MOST_MISSING:
        return f"is no finite number at {100 * missing:.0f} % of the points"
    positive = finite[finite > 0]
    if len(positive) and positive.max() > _MOST_RATIO * positive.min(initial=np.inf):
        low, high = np.quantile(positive, (0.02, 0.98))
        if high > _MOST_RATIO * low:
            return f"spans {low:.0e} to {high:.0e}"
    return ""


def with_intensity(cloud: NDArray[np.float32]) -> NDArray[np.float32]:
    """The cloud, NaN in place of intensities that are none."""
    if intensity_fault(cloud):
        cloud = cloud.copy()
        cloud[:, 3] = np.nan
    return cloud


def read_npy(path: Path) -> NDArray[Any]:
    """The array in a .npy file."""
    try:
        with _PARSER, path.open("rb") as file, warnings.catch_warnings(action="ignore"):
            array = np.load(file, allow_pickle=False)  # warns of headers by Python 2
            rest = file.read(1)
    except _UNREADABLE as error:
        raise FileError(
            path, f"cannot be read as a .npy array ({in_words(error)}); is it complete?"
        ) from None
    if not isinstance(array, np.ndarray):
        raise FileError(path, "is an archive of arrays, expected one array; write it with np.save")
    if rest:
        raise FileError(
            path, f"goes on after the {array.shape} numbers of its header; write it again"
        )
    return array


def cloud_of_array(array: NDArray[Any], path: Path | str) -> RawCloud:
    """The cloud in an array, (n, 3) or (n, 4+) or of named fields."""
    if array.dtype.names:
        numbers = [name for name in array.dtype.names if array.dtype[name].kind in "fiu"]
        return raw_cloud(path, numbers, lambda name: array[name].ravel())
    if array.ndim != 2 or array.dtype.kind not in "fiu":  # noqa: PLR2004
        raise FileError(
            path, f"has shape {array.shape} of {array.dtype}, expected (n, 3) or (n, 4) numbers"
        )
    rows, columns = array.shape
    if columns < _XYZ or columns > _MOST_COLUMNS or columns > max(rows, _XYZI):
        raise FileError(
            path, f"has shape {array.shape}, expected (n, 3) or (n, 4); is it transposed?"
        )
    return RawCloud(make_cloud(*array[:, :_XYZI].T), ("x", "y", "z", "intensity")[:columns])


_READERS: dict[str, Callable[[Path], RawCloud]] = {
    ".npy": lambda path: cloud_of_array(read_npy(path), path), ".bin": read_bin, ".pcd": read_pcd,
    ".ply": read_ply, ".feather": lambda path: raw_cloud(path, *read_feather(path)),
}  # fmt: skip
CLOUD_SUFFIXES = tuple(_READERS)
_READERS |= {suffix: lambda path: raw_cloud(path, *read_lidar(path)) for suffix in SUFFIXES}

_COST = "the error bars become about twice as wide without; record it, or name its field intensity"
"""Measured on data/sample: 1.8 to 2.8 times the error bars without it, with half of the matches."""


def describe_cloud(where: str, cloud: RawCloud) -> Iterator[str]:
    """Notes about a cloud."""
    if cloud.told:
        yield f"{where}: {cloud.told}"
    intensity = cloud.points[:, 3]
    if fault := intensity_fault(cloud.points):
        yield f"{where}: the intensity {fault}: it is none, and is left out; {_COST}"
    elif np.isnan(intensity).all():
        yield f"{where}: no intensity among its fields {' '.join(cloud.fields)}; {_COST}"
    elif np.nanmin(intensity) == np.nanmax(intensity):
        yield f"{where}: the intensity is {np.nanmax(intensity) + 0:g} at all points; {_COST}"
