"""Point clouds in .ply files: the vertices, among elements of any kind."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.point_fields import (
    RawCloud,
    choose_fields,
    lines_of_text,
    raw_cloud,
    read_count,
    read_rows,
    too_long,
)

_HEADER_BYTES = 65536
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class _Property:
    """A number of each item; or a list of them, and ``length`` is the kind of its length."""

    name: str
    kind: str
    length: str | None = None

    @property
    def bytes(self) -> int:
        """Of one number."""
        return np.dtype(self.kind).itemsize


@dataclass(frozen=True)
class _Element:
    """Items with the same properties, one after the other."""

    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        """Whether its items may differ in size."""
        return any(each.length is not None for each in self.properties)

    @property
    def item_bytes(self) -> int:
        """Of one item, if it has no lists."""
        return sum(each.bytes for each in self.properties)


def read_ply(path: Path) -> RawCloud:
    """The vertices of a file."""
    data = path.read_bytes()
    end = _END.search(data[:_HEADER_BYTES])
    if end is None or not data.startswith(b"ply"):
        raise FileError(path, "has no complete .ply header; is it complete?")
    order, elements = _parse(path, data[: end.start()].decode("ascii", "replace"))
    vertices = [each for each in elements if each.name == "vertex"]
    if len(vertices) != 1 or vertices[0].has_lists:
        raise FileError(path, "has no plain list of vertices in its PLY header")
    if not vertices[0].count:
        raise FileError(path, "holds no point")
    names = [each.name for each in vertices[0].properties]
    choose_fields(path, names)  # before points are read as if they were right
    read = _binary_columns if order else _ascii_columns
    columns = read(path, memoryview(data)[end.end() :], order, elements)
    return raw_cloud(path, names, dict(zip(names, columns, strict=True)).__getitem__)


def _parse(path: Path, header: str) -> tuple[str, list[_Element]]:
    """The byte order, "" if it is text, and the elements."""
    order, elements = None, list[_Element]()
    for line in header.split("\n"):
        try:
            match line.split():
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", encoding, _]:
                    order = _ORDERS.get(encoding)
                case ["element", name, count]:
                    elements.append(_Element(name, read_count(count), []))
                case ["property", "list", length, kind, name] if _KINDS[length][0] != "f":
                    each = _Property(name, _KINDS[kind], _KINDS[length])
                    elements[-1].properties.append(each)
                case ["property", kind, *words] if words:
                    elements[-1].properties.append(_Property(" ".join(words), _KINDS[kind]))
                case _:
                    raise ValueError(line)
        except (KeyError, IndexError, ValueError):
            raise FileError(path, f"has a malformed PLY header, at {line[:200]!r}") from None
    if order is None:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    return order, elements


def _ascii_columns(
    path: Path, body: memoryview, _: str, elements: Sequence[_Element]
) -> list[NDArray[Any]]:
    """The values of each property of the vertices: a line per item."""
    at = _vertices_at(elements)
    before = sum(each.count for each in elements[:at] if each.properties)
    rest = islice(lines_of_text(body), min(before, len(body)), None)
    rows = read_rows(path, rest, elements[at].count, [len(elements[at].properties)])
    if not elements[at + 1 :] and next(rest, None) is not None:
        raise too_long(path, elements[at].count)
    return list(rows.T)


def _binary_columns(
    path: Path, body: memoryview, order: str, elements: Sequence[_Element]
) -> list[NDArray[Any]]:
    """The values of each property of the vertices, without a copy."""
    at, start = _vertices_at(elements), 0
    for each in elements[:at]:
        start = _end_of(each, body, order, start)
    count, step = elements[at].count, elements[at].item_bytes
    if start + count * step > len(body):
        raise FileError(path, f"is truncated: it ends before its {count} points; write it again")
    if not elements[at + 1 :] and start + (count + 1) * step <= len(body):
        raise too_long(path, count)
    columns = []
    for prop in elements[at].properties:
        columns.append(np.ndarray((count,), order + prop.kind, body, start, (step,)))
        start += prop.bytes
    return columns


def _vertices_at(elements: Sequence[_Element]) -> int:
    return [each.name for each in elements].index("vertex")


def _end_of(element: _Element, body: memoryview, order: str, start: int) -> int:
    """Where an element ends; beyond the file if it is truncated."""
    if not element.has_lists:
        return start + element.count * element.item_bytes
    at = start
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    for _ in range(element.count):
        for each in element.properties:
            if each.length is not None:
                size = np.dtype(each.length).itemsize
                length = int.from_bytes(
                    body[at : at + size], byte_order, signed=each.length.startswith("i")
                )
                at += size + (length * each.bytes if length >= 0 else len(body))
            else:
                at += each.bytes
        if at > len(body):
            break
    return at
