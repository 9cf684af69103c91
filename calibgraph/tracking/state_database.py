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
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import (
    cannot_write,
    require_place_for_folder,
    sync_folder,
    write_atomically,
)
from calibgraph.tracking.state_recovery import APPLICATION, LAYOUT, TABLES, checksum, log_of, read

DATABASE = "state.sqlite"
_PAGE_BYTES = 32768  # a snapshot takes half the time of SQLite's 4096
_LOG_PAGES = 128  # in the log, before they are copied to the database: 4 MB, as by default
_EARLIEST = ("snapshot-*.state", "journal-*.log")
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
            earliest layout or of a newer one. The folder is left as it was.
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
    for pattern in _EARLIEST:
        for found in path.parent.glob(pattern):
            message = "is state of the earliest layout; choose another folder"
            raise FileError(found, f"{message}, or continue with the calibgraph that wrote it")
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
