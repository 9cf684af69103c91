"""Damaged clouds, tables and bags are read or refused in one line, in little time and memory.

    python -m tests.io.test_fuzz KIND SEED COUNT FOLDER

Prints how many were read, how many refused, and the memory [MB] that it took at most.
"""

import io
import random
import re
import resource
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import feather, parquet

from calibgraph import CalibrationError
from calibgraph.io.bags.messages import Bag
from calibgraph.io.clouds import load_cloud
from calibgraph.io.tables import load_camera_matches, load_correspondences, read_feather
from calibgraph.model.camera_matches import NAMES, NUMBERS, PLANES
from calibgraph.model.correspondences import COORDINATES
from tests.io.written import CLOUD, pcd, ply

DIGITS = [b"0", b"1", b"-1", b"3", b"255", b"499", b"501", b"65536", b"2147483648", b"4294967295",
          b"9223372036854775807", b"18446744073709551616", b"9" * 400, b"1e9", b"nan", b"0x10",
          b"1_000", "٣".encode(), b"", b" "]  # fmt: skip
WORDS = [b"_", b"x", b"F", b"U", b"I", b"8", b"uchar", b"double", b"\n",
         b"\r\n", b"#", b"binary", b"ascii", b"binary_compressed", b"list uchar int a", b"\0",
         b"element face 9\n", b"\xff"]  # fmt: skip
SIZES = (0, 1, 2**31, 2**32 - 1, 2**33, 2**40, 2**62, 2**64 - 1)
MOST_S = {"clouds": 5.0, "tables": 20.0, "bags": 1.0}
HEADER = 250


def clouds(_: Path) -> dict[str, bytes]:
    npy = io.BytesIO()
    np.save(npy, CLOUD)
    faces = b"element face 0\nproperty list uchar int vertex_indices\n"
    body = CLOUD.tobytes()
    return {
        "binary.pcd": pcd(), "padded.pcd": pcd(padding=True), "ascii.pcd": pcd("ascii"),
        "packed.pcd": pcd("binary_compressed"), "little.ply": ply(), "ascii.ply": ply("ascii"),
        "big.ply": ply("binary_big_endian"),
        "mesh.ply": ply(after=faces),
        "four.bin": body, "three.bin": CLOUD[:, :3].tobytes(), "array.npy": npy.getvalue(),
    }  # fmt: skip


def tables(folder: Path) -> dict[str, bytes]:
    rng, rows = np.random.default_rng(0), 500
    names = {n: pa.array([n[-1]] * rows) for n in ("camera", *NAMES)}
    frame = pa.array(rng.integers(0, 5, rows))
    numbers = {n: rng.uniform(1, 90, rows) for n in (*COORDINATES, *NUMBERS, *PLANES, *"xyz")}

    def table(texts: tuple[str, ...], columns: tuple[str, ...]) -> pa.Table:
        given = {**{text: names[text] for text in texts}, "frame": frame}
        return pa.table(given | {n: numbers[n] for n in columns})

    parquet.write_table(table(("camera",), COORDINATES), folder / "table.parquet")
    parquet.write_table(table(NAMES, (*NUMBERS, *PLANES)), folder / "matches.parquet")
    feather.write_feather(table((), ("x", "y", "z")), folder / "sweep.feather", compression="zstd")
    files = ("table.parquet", "matches.parquet", "sweep.feather")
    return {name: (folder / name).read_bytes() for name in files}


def bags(folder: Path) -> dict[str, bytes]:
    """Bags of a few kB."""
    from tests.io.bags.writing import START_NS, Messages, Stamped, structured, write_bag

    found, cloud = {}, structured(np.ones((20, 4), np.float32))
    for kind, compression in (("mcap", "STORAGE"), ("mcap", ""), ("ros1", "BZ2"), ("ros1", "LZ4"),
                              ("sqlite3", "")):  # fmt: skip
        make, name = Messages(kind), f"{kind}_{compression}"
        messages = [
            Stamped("/points", "sensor_msgs/msg/PointCloud2", START_NS + n, make.cloud(cloud, n))
            for n in range(5)
        ]
        bag = write_bag(folder / name, kind, messages, compression=compression)
        file = bag if bag.is_file() else next(bag.glob("drive*"))
        found[f"{name}{file.suffix}"] = file.read_bytes()
    return found


def read_bag(path: Path) -> None:
    bag = Bag(path)
    for _ in bag.messages([*bag.topics]):
        pass


ORIGINALS = {"clouds": clouds, "tables": tables, "bags": bags}
READERS: dict[str, Callable[[Path], object]] = {
    "table.parquet": load_correspondences,
    "matches.parquet": load_camera_matches,
    "sweep.feather": lambda path: [*map(read_feather(path)[1], "xyz")],
}


def _place(data: bytes, rng: random.Random) -> int:
    """Where changes are: mostly in the header."""
    return rng.randrange(max(1, min(len(data), rng.choice([HEADER, HEADER, HEADER, len(data)]))))


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice([1, 1, 8])):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _insert(data: bytes, rng: random.Random) -> bytes:
    at, junk = _place(data, rng), rng.choice([rng.choice(WORDS), rng.randbytes(rng.randrange(40))])
    return data[:at] + junk + data[at:]


def _delete(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice([1, 2, 4, 8, 16, 100, len(data)]) :]


def _replace_word(data: bytes, rng: random.Random) -> bytes:
    """A word of the header, by a number or a word that a header may have."""
    head = data[:HEADER].split(b" ")
    head[rng.randrange(len(head))] = rng.choice([*DIGITS, *WORDS])
    return b" ".join(head) + data[HEADER:]


def _replace_number(data: bytes, rng: random.Random) -> bytes:
    """A run of digits of the header, by another number."""
    at = [n for n, byte in enumerate(data[:HEADER]) if chr(byte).isdigit()] or [0]
    start = end = rng.choice(at)
    while data[end : end + 1].isdigit():
        end += 1
    return data[:start] + rng.choice(DIGITS) + data[end:]


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    size = struct.pack("<Q", rng.choice([*SIZES, rng.randrange(2**32)]))[: rng.choice([1, 4, 8])]
    return data[:at] + size + data[at + len(size) :]


CHANGES = [_flip, _insert, _delete, _replace_word, _replace_number, _overwrite]


def damaged(data: bytes, rng: random.Random, *, at_end: bool) -> bytes:
    """One to three changes, most of them in the header or, if it is there, in the footer."""
    data = data[::-1] if at_end else data
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        data = rng.choice(CHANGES)(data, rng)
    return data[::-1] if at_end else data


def with_another_header(data: bytes, rng: random.Random) -> bytes:
    """A change before the points, which stay: they may be refused, but not become others."""
    end = re.search(rb"DATA|end_header|\n$", data[:HEADER] if data[0] != 0x93 else data[:128])
    at = end.end() if end else 0
    return rng.choice(CHANGES)(data[:at], rng) + data[at:] if at else data


def check(kind: str, path: Path, data: bytes, *, same: bool = False) -> bool:
    """Whether it was read, if ``same`` as CLOUD; another error than of the file is the reader's."""
    path.write_bytes(data)
    start = time.process_time()
    try:
        if kind == "clouds":
            cloud = load_cloud(path)
            assert cloud.dtype == np.float32 and np.isfinite(cloud[:, :3]).all()
            assert not same or np.array_equal(cloud[:, :3], CLOUD[:, :3]), "other points"
            assert cloud.nbytes <= 100 * len(data), "more points than the file can hold"
        else:
            READERS.get(path.name, read_bag)(path)
    except CalibrationError as error:
        assert "\n" not in str(error) and str(path) in str(error), error
        return False
    finally:
        assert time.process_time() - start < MOST_S[kind]
    return True


def main(kind: str, seed: int, count: int, folder: Path) -> None:
    rng, files = random.Random(seed), ORIGINALS[kind](folder)
    for name, data in files.items():
        assert check(kind, folder / name, data), name
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read, end_share = 0, {"clouds": 0.0, "tables": 0.8, "bags": 0.6}[kind]
    for number in range(count):
        name = rng.choice(list(files))
        same = kind == "clouds" and number % 2 == 0
        data = (
            with_another_header(files[name], rng) if same
            else damaged(files[name], rng, at_end=rng.random() < end_share)
        )  # fmt: skip
        (folder / "last").write_text(f"{number} {name}")
        read += check(kind, folder / name, data, same=same)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(read, count - read, grown // 1024)


OFTEN = (pytest.mark.slow, pytest.mark.ci)


@pytest.mark.parametrize(
    ("kind", "count", "most_mb"),
    [
        pytest.param(
            "clouds", 300, 300, marks=OFTEN
        ),  # that numpy takes for a moment; a header may claim exabytes
        pytest.param("clouds", 10_000, 300, marks=pytest.mark.slow),
        pytest.param("tables", 300, 300, marks=pytest.mark.slow),
        pytest.param("bags", 60, 200, marks=OFTEN),
        pytest.param("bags", 2000, 200, marks=pytest.mark.slow),
    ],
)
def test_damaged_files_are_read_or_refused(
    kind: str, count: int, most_mb: int, tmp_path: Path
) -> None:
    if kind == "bags":
        pytest.importorskip("mcap")
    command = [sys.executable, "-m", "tests.io.test_fuzz", kind, "1", str(count), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    last = tmp_path / "last"
    told = last.read_text() if last.exists() else ""
    assert done.returncode == 0, f"{told}: {done.returncode} {done.stderr[-1000:]}"
    read, refused, grown_mb = map(int, done.stdout.split())
    assert read > (0 if kind == "tables" else count / 20) and refused > count / 3
    assert grown_mb < most_mb


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
