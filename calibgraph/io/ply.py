"""Point clouds in .ply files: their vertices, beside which there are no faces or others."""

import re
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.io.point_fields import (
    Field,
    RawCloud,
    binary_columns,
    choose_fields,
    raw_cloud,
    read_count,
    read_rows,
)

_HEADER_BYTES = 65536
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


def read_ply(path: Path) -> RawCloud:
    """The vertices of a file."""
    data = path.read_bytes()
    end = _END.search(data[:_HEADER_BYTES])
    if end is None or not data.startswith(b"ply"):
        raise FileError(path, "has no complete .ply header; is it complete?")
    header = data[: end.start()].decode("ascii", "replace")
    order, count, fields = _parse(path, header)
    names = [each.name for each in fields]
    choose_fields(path, names)  # before points are read as if they were right
    body = memoryview(data)[end.end() :]
    columns = (
        binary_columns(path, body, count, fields) if order
        else read_rows(path, body, count, [len(fields)]).T
    )  # fmt: skip
    return raw_cloud(path, names, dict(zip(names, columns, strict=True)).__getitem__)


def _parse(path: Path, header: str) -> tuple[str, int, list[Field]]:
    """The byte order, "" if it is text; number and fields of the vertices."""
    order, elements, counts, fields = None, list[str](), dict[str, int](), list[Field]()
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
                        fields.append(Field(" ".join(words), _KINDS[kind]))
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
    return order, count, [Field(f.name, order + f.kind) for f in fields]
