"""Point clouds in .ply files: the vertices, among elements of any kind."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.point_fields import (
    Field,
    RawCloud,
    binary_columns,
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
class _Element:
    """Items with the same properties, one after the other."""

    name: str
    count: int
    properties: list[Field]

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
                    each = Field(name, _KINDS[kind], 1, _KINDS[length])
                    elements[-1].properties.append(each)
                case ["property", kind, *words] if words:
                    elements[-1].properties.append(Field(" ".join(words), _KINDS[kind]))
                case _:
                    raise ValueError(line)
        except (KeyError, IndexError, ValueError):
            raise FileError(path, f"has a malformed PLY header, at {line[:200]!r}") from None
    if order is None:
        raise FileError(path, "has an unknown encoding in its header; write it as binary or ascii")
    return order, elements


def _ascii_columns(
    path: Path, body: memoryview, _: str, elements: Sequence[_Element]
) -> Iterable[NDArray[Any]]:
    """The values of each property of the vertices: a line per item."""
    at = _vertices_at(elements)
    before = sum(each.count for each in elements[:at] if each.properties)
    rest = islice(lines_of_text(body), min(before, len(body)), None)
    rows = read_rows(path, rest, elements[at].count, [len(elements[at].properties)])
    if not elements[at + 1 :] and next(rest, None) is not None:
        raise too_long(path, elements[at].count)
    return rows.T


def _binary_columns(
    path: Path, body: memoryview, order: str, elements: Sequence[_Element]
) -> Iterable[NDArray[Any]]:
    """The values of each property of the vertices, without a copy."""
    at, start = _vertices_at(elements), 0
    for each in elements[:at]:
        start = _end_of(each, body, order, start)
    vertices = elements[at]
    if not elements[at + 1 :] and start + (vertices.count + 1) * vertices.item_bytes <= len(body):
        raise too_long(path, vertices.count)
    fields = [replace(each, kind=order + each.kind) for each in vertices.properties]
    return binary_columns(path, body, vertices.count, fields, start=start)


def _vertices_at(elements: Sequence[_Element]) -> int:
    return [each.name for each in elements].index("vertex")


def _end_of(element: _Element, body: memoryview, order: str, start: int) -> int:
    """Where an element ends; beyond the file if it is truncated."""
    if not element.has_lists:
        return start + element.count * element.item_bytes
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    for _ in range(element.count):
        for each in element.properties:
            count = 1
            if each.length is not None:
                place = slice(start, start + np.dtype(each.length).itemsize)
                signed = each.length.startswith("i")
                count = int.from_bytes(body[place], byte_order, signed=signed)
                start = place.stop
            start += count * each.bytes if count >= 0 else len(body)
        if start > len(body):
            break
    return start
