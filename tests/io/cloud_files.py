"""Clouds written by hand: .pcd and .ply, in every encoding."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

_RNG = np.random.default_rng(0)
CLOUD = np.column_stack([_RNG.normal(0, (20, 10, 1), (500, 3)), _RNG.integers(1, 256, 500) / 256])
CLOUD = CLOUD.astype(np.float32)


def pcd(encoding: str = "binary", *, padding: bool = False) -> bytes:
    """CLOUD as PCL writes it: with padding, as a PointXYZI in memory."""
    rows = padded() if padding else fields_of(CLOUD)
    return pcd_of(rows, encoding)


def fields_of(cloud: NDArray[np.float32], kind: str = "<f4") -> NDArray[np.void]:
    """(n,) x, y, z, intensity of a cloud."""
    rows = np.zeros(len(cloud), [(name, kind) for name in ("x", "y", "z", "intensity")])
    for column, name in enumerate(rows.dtype.names or ()):
        rows[name] = cloud[:, column]
    return rows


def padded() -> NDArray[np.void]:
    """(n,) CLOUD with padding of 4 and 12 bytes; names after the first underscore are cut."""
    kind = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_0", "u1", 4), ("intensity", "<f4"),
            ("_1", "u1", 12)]  # fmt: skip
    rows = np.zeros(len(CLOUD), kind)
    for column, name in enumerate(("x", "y", "z", "intensity")):
        rows[name] = CLOUD[:, column]
    rows["_0"], rows["_1"] = 0xA5, 0x5A  # as if from memory
    return rows


def pcd_of(
    rows: NDArray[np.void], encoding: str = "binary", first: str = "", points: int = 0
) -> bytes:
    """The .pcd of a structured array; names that begin with _ are padding.

    Args:
        rows: (n,) fields, of several numbers each, too.
        encoding: of DATA.
        first: lines above the header.
        points: as the header states it; their number if 0.
    """
    names = rows.dtype.names or ()
    kinds = [rows.dtype[name] for name in names]
    count = points or len(rows)
    header = {
        "VERSION": ["0.7"],
        "FIELDS": ["_" if name.startswith("_") else name for name in names],
        "SIZE": [kind.base.itemsize for kind in kinds],
        "TYPE": [{"f": "F", "i": "I", "u": "U"}[kind.base.kind] for kind in kinds],
        "COUNT": [int(np.prod(kind.shape, dtype=int)) for kind in kinds],
        "WIDTH": [count], "HEIGHT": [1], "VIEWPOINT": [0, 0, 0, 1, 0, 0, 0], "POINTS": [count],
        "DATA": [encoding],
    }  # fmt: skip
    lines = "".join(f"{key} {' '.join(map(str, words))}\n" for key, words in header.items())
    return (first + lines).encode() + _BODIES[encoding](rows)


def _text(rows: NDArray[np.void]) -> bytes:
    columns = [rows[name].reshape(len(rows), -1) for name in rows.dtype.names or ()]
    numbers = zip(*(column.tolist() for column in columns), strict=True)
    lines = (" ".join(repr(n) for part in row for n in part) for row in numbers)
    return "".join(f"{line}\n" for line in lines).encode()


def _packed(rows: NDArray[np.void]) -> bytes:
    plain = b"".join(rows[name].tobytes() for name in rows.dtype.names or ())
    packed = lzf_of_literals(plain)
    return struct.pack("<II", len(packed), len(plain)) + packed


def lzf_of_literals(data: bytes) -> bytes:
    """LZF that repeats nothing."""
    parts = [data[at : at + 32] for at in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


_BODIES = {
    "ascii": _text, "binary": lambda rows: rows.tobytes(), "binary_compressed": _packed,
}  # fmt: skip


def ply(
    encoding: str = "binary_little_endian", *, before: bytes = b"", after: bytes = b"",
    body: bytes | None = None, names: tuple[str, ...] = ("x", "y", "z", "intensity"),
) -> bytes:  # fmt: skip
    """CLOUD as .ply.

    Args:
        encoding: of its numbers.
        before: elements of the header before the vertices.
        after: elements after them.
        body: in place of CLOUD's.
        names: of the properties.
    """
    order = ">" if encoding == "binary_big_endian" else "<"
    rows = fields_of(CLOUD, f"{order}f4")
    written = _text(rows) if encoding == "ascii" else rows.tobytes()
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat {encoding} 1.0\ncomment by hand\n".encode() + before
    header += f"element vertex {len(rows)}\n{properties}".encode() + after + b"end_header\n"
    return header + (written if body is None else body)
