"""A tracker's state on disk: an SQLite database of snapshots and of the inputs since.

``state.sqlite`` has three tables. ``journal`` holds the inputs in order, each with its number.
``snapshot`` holds the state after a number of inputs. Their rows have checksums, since SQLite
checks its log but not its pages. ``status`` holds the number of the last input, by which missing
rows are noticed, and whether a log is in use, by which a missing log is noticed.

With a write-ahead log and ``synchronous=FULL``, a row is on disk when its transaction returns, and
a crash leaves all of a transaction or none.

Two snapshots are kept, and the inputs since the older one, which replaces a damaged newer one.
"""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import (
    cannot_write,
    require_file,
    require_place_for_folder,
    sync_folder,
    write_atomically,
)

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


DATABASE = "state.sqlite"
_PAGE_BYTES = 32768  # a snapshot takes half the time of SQLite's 4096
_LOG_PAGES = 128  # in the log, before they are copied to the database: 4 MB, as by default
_TABLES = f"""
    PRAGMA page_size={_PAGE_BYTES};
    BEGIN;
    PRAGMA application_id={APPLICATION};
    PRAGMA user_version={LAYOUT};
    {"".join(f"CREATE TABLE {name} {columns};" for name, columns in TABLES.items())}
    INSERT INTO status VALUES (0, 0);
    COMMIT;
    PRAGMA journal_mode=WAL;
"""


class StateDatabase:
    """The state of one tracker in a folder, locked against a second process.

    After a write has failed, every further one is refused.

    Args:
        folder: where the state is kept; made if it is not there.

    Attributes:
        recovered: what the database held when it was opened.

    Raises:
        FileError: if another process uses the folder, or its state is damaged, foreign, of the
            another layout. The folder is left as it was.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / DATABASE
        _make_folder(folder)
        self._lock: int | None = _lock(folder)
        self._connection: sqlite3.Connection | None = None  # opened by the first write
        self._failed = False
        try:
            if not self._path.exists():
                _create(self._path)
            self.recovered, self._number = read(self._path)
        except BaseException:
            self.close()
            raise

    def append(self, *contents: bytes) -> None:
        """Add inputs to the journal; they are durable when this returns, all or none.

        Raises:
            OSError: if they cannot be written; the earlier inputs are safe.
        """
        rows = [
            (number, content, checksum(number, content))
            for number, content in enumerate(contents, self._number + 1)
        ]
        last = self._number + len(rows)
        with self._writing() as connection:
            connection.executemany("INSERT INTO journal VALUES (?, ?, ?)", rows)
            connection.execute("UPDATE status SET number = ?", (last,))
        self._number = last

    @property
    def number(self) -> int:
        """Number of the last input."""
        return self._number

    def snapshot(self, state: bytes, number: int | None = None) -> None:
        """Keep ``state``, which the inputs up to a number (the last) led to; durable on return.

        Snapshots and inputs older than the snapshot before this one are removed.

        Raises:
            OSError: if it cannot be written; the earlier snapshot and the inputs are safe.
        """
        number = self._number if number is None else number
        row = number, state, checksum(number, state)
        with self._writing() as connection:
            connection.execute("INSERT OR REPLACE INTO snapshot VALUES (?, ?, ?)", row)
            (kept,) = connection.execute(
                "SELECT min(number) FROM (SELECT number FROM snapshot ORDER BY number DESC LIMIT 2)"
            ).fetchone()
            connection.execute("DELETE FROM snapshot WHERE number < ?", (kept,))
            connection.execute("DELETE FROM journal WHERE number <= ?", (kept,))

    def close(self) -> None:
        """Release the folder; nothing is left to write."""
        connection, self._connection = self._connection, None
        lock, self._lock = self._lock, None
        if connection is not None:
            with suppress(sqlite3.Error):  # of a full disk: then the next one warns in vain
                connection.rollback()
                connection.execute("UPDATE status SET is_open = 0")
            connection.close()  # copies the log into the database and removes it
        if lock is not None:
            os.close(lock)

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """A transaction. An error ends all writing: whether it is on disk is unknown then."""
        if self._lock is None or self._failed:
            raise ValueError(f"{self._path}: is closed; open its folder anew")
        try:
            self._connection = self._connection or _connect(self._path)
            self._connection.execute("BEGIN")
            yield self._connection
            self._connection.execute("COMMIT")
        except BaseException as error:
            self._failed = True
            if isinstance(error, sqlite3.Error):
                raise _cannot_write(self._path, error) from error
            raise


def _make_folder(folder: Path) -> None:
    require_place_for_folder(folder)
    new = [part for part in (folder, *folder.parents) if not part.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for part in new:
        sync_folder(part.parent)


def _lock(folder: Path) -> int:
    """A descriptor that holds the folder's lock until it is closed, or the process ends."""
    path = folder / "lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    except OSError as error:
        if path.is_symlink() or path.is_dir():
            raise FileError(path, "is a link or a folder, expected a file; remove it") from error
        raise
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BaseException as error:
        os.close(descriptor)
        if isinstance(error, BlockingIOError):
            message = "is in use by another process; stop that one, or choose another folder"
            raise FileError(folder, message) from None
        raise
    return descriptor


def _create(path: Path) -> None:
    """Put an empty database in place, whole or not at all; not beside another one's parts.

    It is written before it has a log, whose copy at the end would not report a full disk.
    """
    if log_of(path).exists():
        raise FileError(path, "is missing, and its log is there; restore it from a copy")
    for leftover in path.parent.glob(f".writing-*{path.suffix}*"):
        leftover.unlink()

    def write(part: Path) -> None:
        try:
            with closing(sqlite3.connect(part, isolation_level=None)) as connection:
                connection.executescript(_TABLES)
        except sqlite3.Error as error:
            raise _cannot_write(path, error) from error

    write_atomically(path, write)


_OPEN_FOR_WRITING = f"""
    PRAGMA locking_mode=EXCLUSIVE;
    PRAGMA journal_mode=WAL;
    PRAGMA synchronous=FULL;
    PRAGMA wal_autocheckpoint={_LOG_PAGES};
    UPDATE status SET is_open = 1;
    PRAGMA wal_checkpoint(PASSIVE);
"""


def _connect(path: Path) -> sqlite3.Connection:
    """A connection for writing, which no other can share; it is noted in the database itself."""
    connection = sqlite3.connect(path, timeout=0, isolation_level=None, check_same_thread=False)
    try:
        connection.executescript(_OPEN_FOR_WRITING)
    except BaseException:
        connection.close()
        raise
    return connection


def _cannot_write(path: Path, error: sqlite3.Error) -> OSError:
    full = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
    return cannot_write(path, error, errno.ENOSPC if full else errno.EIO)
