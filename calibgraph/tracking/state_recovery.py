"""Reading a tracker's state from its database, without changing any file."""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import require_file

LAYOUT = 2
APPLICATION = 0x43474254
"""``CGBT``, in the header of the database."""

TABLES = {
    "snapshot": "(number INTEGER PRIMARY KEY, content BLOB NOT NULL, digest BLOB NOT NULL)",
    "journal": "(number INTEGER PRIMARY KEY, content BLOB NOT NULL, digest BLOB NOT NULL)",
    "status": "(number INTEGER NOT NULL, is_open INTEGER NOT NULL)",
}
"""Their columns. A database with anything else, such as a trigger, is none of a tracker."""

_SCHEMA = [("table", name, name, f"CREATE TABLE {name} {TABLES[name]}") for name in TABLES]

_LEAST_STEPS = 100_000
_OF_THE_DISK = sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL, sqlite3.SQLITE_CANTOPEN
_HEADER = struct.Struct(">16s44xI4xI28x")  # text, user_version, application_id


@dataclass(frozen=True)
class Recovered:
    """What a database holds.

    Attributes:
        snapshot: the newest undamaged snapshot; None if there is none yet.
        inputs: the inputs after it, in order; the last may be one that was not acknowledged.
        damages: one line for each damaged snapshot, and for a log that is missing.
    """

    snapshot: bytes | None
    inputs: tuple[bytes, ...]
    damages: tuple[str, ...]


def log_of(path: Path) -> Path:
    """The write-ahead log of a database."""
    return path.with_name(f"{path.name}-wal")


def read(path: Path) -> tuple[Recovered, int]:
    """What the database holds, and the number of its last input; no file is changed.

    Raises:
        FileError: if it is damaged, of another layout, or of another program, then without opening
            it.
    """
    _require_layout(path)
    log = log_of(path)
    had_log = log.exists() and log.stat().st_size > 0
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True)) as database:
            # A query takes less than an instruction per byte of a database of ours; of another
            # one, whose pages may refer to each other in circles, it might never end.
            steps = _LEAST_STEPS + path.stat().st_size + (log.stat().st_size if had_log else 0)
            database.set_progress_handler(lambda: 1, steps)
            query = "SELECT type, name, tbl_name, sql FROM sqlite_schema"
            if database.execute(query).fetchmany(len(_SCHEMA) + 1) != _SCHEMA:
                message = "holds other tables than a tracker's; choose another folder"
                raise FileError(path, message)
            (state,) = database.execute("PRAGMA integrity_check(1)").fetchone()
            if state != "ok":
                raise _damaged(path, state)
            number, is_open = database.execute("SELECT number, is_open FROM status").fetchone()
            recovered = _recover(database, path, number)
    except (sqlite3.Error, TypeError, UnicodeError) as error:  # TypeError: a row is missing
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _OF_THE_DISK:
            message = f"cannot be read ({error}): is the disk full? Free it and start again"
            raise FileError(path, message) from error
        raise _damaged(path, error) from error
    finally:
        _remove_index(path, had_log=had_log)
    if is_open and not had_log:
        line = f"{log}: is missing, updates may be lost; went on after input {number}"
        recovered = replace(recovered, damages=(*recovered.damages, line))
    return recovered, number


def _require_layout(path: Path) -> None:
    """By the header alone: to open a database may change the files beside it."""
    with require_file(path).open("rb") as file:
        header = file.read(_HEADER.size)
    if len(header) < _HEADER.size or not header.startswith(b"SQLite format 3\0"):
        raise _damaged(path, "it has no header of SQLite")
    _, layout, application = _HEADER.unpack(header)
    if application != APPLICATION:
        raise FileError(path, "is a database of another program; choose another folder")
    if layout != LAYOUT:
        message = f"is state of layout {layout}, expected {LAYOUT}; choose another folder"
        raise FileError(path, f"{message}, or continue with the calibgraph that wrote it")


def _remove_index(path: Path, *, had_log: bool) -> None:
    """Remove what reading leaves beside a database: the index of the log, and an empty log."""
    path.with_name(f"{path.name}-shm").unlink(missing_ok=True)
    if not had_log:
        log_of(path).unlink(missing_ok=True)


def _recover(database: sqlite3.Connection, path: Path, newest: int) -> Recovered:
    """The newest undamaged snapshot, and all inputs after it up to the newest."""
    damages: list[str] = []
    start, snapshot = 0, None
    query = "SELECT number, content, digest FROM snapshot ORDER BY number DESC"
    for number, content, digest in database.execute(query):
        if digest == checksum(number, content):
            start, snapshot = number, content
            break
        damages.append(f"{path}: the snapshot after input {number} is damaged: not used")
    if damages and snapshot is None:
        raise _damaged(path, "no snapshot has the right checksum")
    query = "SELECT number, content, digest FROM journal WHERE number > ? ORDER BY number"
    rows = database.execute(query, (start,)).fetchall()
    for expected, row in zip_longest(range(start + 1, newest + 1), rows):
        if row is None or row[0] != expected or row[2] != checksum(*row[:2]):
            raise _damaged(path, f"input {expected} is missing or has a wrong checksum")
    return Recovered(snapshot, tuple(content for _, content, _ in rows), tuple(damages))


def checksum(number: int, content: object) -> bytes:
    """Checksum of a row, none of one that is not bytes."""
    if not isinstance(content, bytes):
        return b""
    return hashlib.sha256(str(number).encode() + b" " + content).digest()


def _damaged(path: Path, why: object) -> FileError:
    advice = "restore its folder from a copy, or choose another folder"
    return FileError(path, f"is damaged ({why}); {advice}")
