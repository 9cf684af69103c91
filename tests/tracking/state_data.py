"""Databases of inputs for the tests of the state on disk.

The "state" in these tests is all inputs so far, one after the other: so what a folder holds, its
snapshot and the inputs after it, is comparable with the truth byte by byte.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from calibgraph.errors import FileError
from calibgraph.tracking.state_database import DATABASE, Recovered, StateDatabase

INPUT_BYTES = 3
LOG = f"{DATABASE}-wal"
Files = dict[str, bytes]


def inputs(number: int, *, first: int = 0) -> list[bytes]:
    return [f"{i:0{INPUT_BYTES}d}".encode() for i in range(first, first + number)]


def drive(
    database: StateDatabase, number: int, *, done: bytes = b"", snapshot_every: int = 3
) -> Iterator[bytes]:
    """Append inputs, with a snapshot now and then; yields all that is acknowledged each time."""
    for count, record in enumerate(inputs(number, first=len(done) // INPUT_BYTES), start=1):
        database.append(record)
        done += record
        yield done
        if count % snapshot_every == 0:
            database.snapshot(done)


@contextmanager
def opened(folder: Path) -> Iterator[StateDatabase]:
    with closing(StateDatabase(folder)) as database:
        yield database


def filled(folder: Path, number: int, *, snapshot_every: int = 3) -> bytes:
    """A folder after a number of inputs; returns the truth it should hold."""
    with opened(folder) as database:
        database.snapshot(b"")
        return list(drive(database, number, snapshot_every=snapshot_every))[-1]


def recovered(folder: Path) -> Recovered:
    with opened(folder) as database:
        return database.recovered


def held(result: Recovered) -> bytes:
    return (result.snapshot or b"") + b"".join(result.inputs)


def content(folder: Path) -> Files:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def restored(folder: Path, files: Files) -> Path:
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder


def require_usable(folder: Path, truth: bytes) -> None:
    """A folder holds the truth, without damage, and takes more."""
    with opened(folder) as database:
        assert (held(database.recovered), database.recovered.damages) == (truth, ())
        *_, truth = drive(database, 4, done=truth)
    assert held(recovered(folder)) == truth


def require_refused(folder: Path, match: str) -> None:
    """A folder is refused in one line, and no byte of it is changed."""
    before = content(folder)
    with pytest.raises(FileError, match=match) as refused:
        StateDatabase(folder)
    assert "\n" not in str(refused.value)
    assert content(folder) | {"lock": b""} == before | {"lock": b""}
