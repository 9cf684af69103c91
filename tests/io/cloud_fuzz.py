"""Damaged clouds: every reader gives points or one line, in a child process that may not die.

    python -m tests.io.cloud_fuzz SEED COUNT FOLDER

Prints how many were read, how many refused, and the memory that it took at most.
"""

from __future__ import annotations

import io
import random
import re
import resource
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from calibgraph import FileError
from calibgraph.io.clouds import load_cloud
from tests.io.written import CLOUD, pcd, ply

NUMBERS = [b"0", b"1", b"-1", b"3", b"255", b"499", b"501", b"65536", b"2147483648", b"4294967295",
           b"9223372036854775807", b"18446744073709551616", b"9" * 400, b"1e9", b"nan", b"0x10",
           b"1_000", "٣".encode(), b"", b" "]  # fmt: skip
WORDS = [b"_", b"x", b"F", b"U", b"I", b"8", b"uchar", b"double", b"\n",
         b"\r\n", b"#", b"binary", b"ascii", b"binary_compressed", b"list uchar int a", b"\0",
         b"element face 9\n", b"\xff"]  # fmt: skip


def originals() -> dict[str, bytes]:
    npy = io.BytesIO()
    np.save(npy, CLOUD)
    faces = b"element face 2\nproperty list uchar int vertex_indices\n"
    body = CLOUD.tobytes()
    return {
        "binary.pcd": pcd(), "padded.pcd": pcd(padding=True), "ascii.pcd": pcd("ascii"),
        "packed.pcd": pcd("binary_compressed"), "little.ply": ply(), "ascii.ply": ply("ascii"),
        "big.ply": ply("binary_big_endian"),
        "mesh.ply": ply(before=faces, body=(b"\x03" + bytes(12)) * 2 + body),
        "four.bin": body, "three.bin": CLOUD[:, :3].tobytes(), "array.npy": npy.getvalue(),
    }  # fmt: skip


def mutate(data: bytes, rng: random.Random) -> bytes:
    """One to three changes, most of them in the header."""
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        data = rng.choice(MUTATIONS)(data, rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 8])):
        at = rng.randrange(_header(data, rng)) if changed else 0
        changed[at : at + 1] = bytes([changed[at] ^ 1 << rng.randrange(8)]) if changed else b""
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(_header(data, rng))]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(_header(data, rng))
    return (
        data[:at] + rng.choice([rng.choice(WORDS), rng.randbytes(rng.randrange(1, 40))]) + data[at:]
    )


def _delete(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(_header(data, rng))
    return data[:at] + data[at + rng.choice([1, 2, 4, 16, 100]) :]


def _replace_word(data: bytes, rng: random.Random) -> bytes:
    """A word of the header, by a number or a word that a header may have."""
    head = data[:_HEADER].split(b" ")
    head[rng.randrange(len(head))] = rng.choice([*NUMBERS, *WORDS])
    return b" ".join(head) + data[_HEADER:]


def _replace_number(data: bytes, rng: random.Random) -> bytes:
    """A run of digits of the header, by another number."""
    at = [n for n, byte in enumerate(data[:_HEADER]) if chr(byte).isdigit()] or [0]
    start = end = rng.choice(at)
    while data[end : end + 1].isdigit():
        end += 1
    return data[:start] + rng.choice(NUMBERS) + data[end:]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(_header(data, rng))
    size = struct.pack("<I", rng.choice([0, 1, 2**31, 2**32 - 1, rng.randrange(2**32)]))
    return data[:at] + size + data[at + 4 :]


_HEADER = 250
MUTATIONS: list[Callable[[bytes, random.Random], bytes]] = [
    _flip, _cut, _insert, _delete, _replace_word, _replace_number, _overwrite,
]  # fmt: skip


def _header(data: bytes, rng: random.Random) -> int:
    """Where changes end: mostly in the header."""
    return max(1, min(len(data), rng.choice([_HEADER, _HEADER, _HEADER, len(data)])))


def mutate_header(data: bytes, rng: random.Random) -> bytes:
    """A change before the points, which stay: they may be refused, but not become others."""
    end = re.search(rb"DATA|end_header|\n$", data[:_HEADER] if data[0] != 0x93 else data[:128])
    at = end.end() if end else 0
    return rng.choice(MUTATIONS)(data[:at], rng) + data[at:] if at else data


def check(path: Path, data: bytes, same: bool = False) -> bool:
    """Whether it was read, if ``same`` as CLOUD; another error than of the file is the reader's."""
    path.write_bytes(data)
    try:
        cloud = load_cloud(path)
    except FileError as error:
        assert "\n" not in str(error) and str(path) in str(error), error
        return False
    assert cloud.dtype == np.float32 and cloud.shape[1] == 4 and np.isfinite(cloud[:, :3]).all()
    assert not same or np.array_equal(cloud[:, :3], CLOUD[:, :3]), "other points"
    assert cloud.nbytes <= 100 * len(data), "more points than the file can hold"
    return True


def main(seed: int, count: int, folder: Path) -> None:
    rng, files = random.Random(seed), originals()
    for name, data in files.items():
        assert check(folder / name, data), name
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read = 0
    for number in range(count):
        name = rng.choice(list(files))
        same = number % 2 == 0
        data = (mutate_header if same else mutate)(files[name], rng)
        (folder / "last").write_text(f"{number} {name}")
        read += check(folder / name, data, same)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(read, count - read, grown // 1024)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
