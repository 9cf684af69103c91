"""Spoilt bags: every reader gives messages or one line, in a child process that may not die.

    python -m tests.io.bags.fuzz SEED COUNT FOLDER

Prints how many were read, how many refused, and the memory that it took at most.
"""

from __future__ import annotations

import random
import resource
import struct
import sys
import time
from pathlib import Path

import numpy as np

from calibgraph import FileError
from calibgraph.io.bags.messages import Bag
from tests.io.bags.writing import (
    START_NS,
    Messages,
    Stamped,
    structured,
    write_bag,
)

SIZES = (0, 1, 2**31, 2**32 - 1, 2**33, 2**40, 2**62, 2**64 - 1)
MOST_S = 1.0


def originals(folder: Path) -> dict[str, bytes]:
    """Bags of a few kB, by the name of their file."""
    found = {}
    cloud = structured(np.ones((20, 4), np.float32))
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


def spoil(data: bytes, rng: random.Random) -> bytes:
    """One to three changes; most near the ends, where headers and indexes are."""
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 3])):
        near = rng.choice([200, 200, len(changed)])
        at = rng.randrange(min(near, len(changed)))
        at = at if rng.random() < 0.4 else len(changed) - 1 - at
        kind = rng.randrange(5)
        if kind == 0:
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            size = struct.pack("<Q", rng.choice(SIZES))[: rng.choice([4, 8])]
            changed[at : at + len(size)] = size
        elif kind == 2:
            del changed[at : at + rng.choice([1, 2, 8, 100])]
        elif kind == 3:
            changed[at:at] = rng.randbytes(rng.randrange(1, 30))
        else:
            changed[at] = rng.randrange(256)
    return bytes(changed)


def check(path: Path, data: bytes) -> bool:
    """Whether it was read; any other error than of the file is the reader's."""
    path.write_bytes(data)
    start = time.process_time()
    try:
        bag = Bag(path)
        for _ in bag.messages([*bag.topics]):
            pass
    except FileError as error:
        assert "\n" not in str(error) and str(path) in str(error), error
        return False
    finally:
        taken_s = time.process_time() - start
        assert taken_s < MOST_S, taken_s
    return True


def main(seed: int, count: int, folder: Path) -> None:
    rng, files = random.Random(seed), originals(folder)
    for name, data in files.items():
        assert check(folder / name, data), name
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    read = 0
    for number in range(count):
        name = rng.choice(list(files))
        (folder / "last").write_text(f"{number} {name}")
        read += check(folder / name, spoil(files[name], rng))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    print(read, count - read, grown // 1024)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
