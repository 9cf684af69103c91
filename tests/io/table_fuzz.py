"""Damaged tables: each is read or refused in one line, in a child process of its own.

    python -m tests.io.table_fuzz SEED COUNT FOLDER

Prints how many were read, how many refused, and the most memory [MB] that one took.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import feather, parquet

from calibgraph import CalibrationError
from calibgraph.io.camera_match_tables import load_camera_matches
from calibgraph.io.correspondence_tables import load_correspondences
from calibgraph.io.feather import read_feather
from calibgraph.model.camera_matches import NAMES, NUMBERS, PLANES
from calibgraph.model.table_columns import COORDINATES
from tests.io.cloud_fuzz import mutate

ROWS, MOST_S = 500, 20
READERS = {
    "correspondences.parquet": load_correspondences,
    "matches.parquet": load_camera_matches,
    "sweep.feather": lambda path: read_feather(path, ("x", "y", "z")),
}


def originals(folder: Path) -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    names = {n: pa.array([n[-1]] * ROWS) for n in ("camera", *NAMES)}
    frame = pa.array(rng.integers(0, 5, ROWS))
    numbers = {n: rng.uniform(1, 90, ROWS) for n in (*COORDINATES, *NUMBERS, *PLANES, *"xyz")}

    def table(texts: tuple[str, ...], columns: tuple[str, ...]) -> pa.Table:
        given = {**{text: names[text] for text in texts}, "frame": frame}
        return pa.table(given | {n: numbers[n] for n in columns})

    parquet.write_table(table(("camera",), COORDINATES), folder / "correspondences.parquet")
    parquet.write_table(table(NAMES, (*NUMBERS, *PLANES)), folder / "matches.parquet")
    feather.write_feather(table((), ("x", "y", "z")), folder / "sweep.feather", compression="zstd")
    return {name: (folder / name).read_bytes() for name in READERS}


def read_in_child(path: Path) -> tuple[int, int]:
    """How it ended, 0 if read and 2 if refused, and the memory that it had at most [MB]."""
    child = os.fork()
    if not child:
        signal.alarm(MOST_S)
        try:
            READERS[path.name](path)
            code = 0
        except CalibrationError as error:
            code = 2 if "\n" not in str(error) else 3
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr)
            code = 4
        os._exit(code)
    _, status, used = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), used.ru_maxrss // 1024


def main(seed: int, count: int, folder: Path) -> None:
    rng, files = random.Random(seed), originals(folder)
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    assert all(read_in_child(folder / name)[0] == 0 for name in files)
    ended, most, slowest = [], 0, 0.0
    for number in range(count):
        name = rng.choice(list(files))
        data = files[name]
        at_end = rng.random() < 0.8  # where the footer is
        data = mutate(data[::-1], rng)[::-1] if at_end else mutate(data, rng)
        (folder / name).write_bytes(data)
        start = time.monotonic()
        code, used = read_in_child(folder / name)
        assert code in (0, 2), f"number {number}, {name}: {code}"
        slowest = max(slowest, time.monotonic() - start)
        ended.append(code)
        most = max(most, used - base)
    print(ended.count(0), ended.count(2), most)
    print(f"slowest {slowest:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
