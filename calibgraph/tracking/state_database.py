"""A tracker's state on disk: an SQLite database with the state in its first row, then the inputs.

With a write-ahead log and ``synchronous=FULL``, rows are on disk when their transaction returns,
and a crash leaves all of it or none. Rows are numbered, so that a missing one is noticed; what they
hold has a checksum of its own (``calibgraph.tracking.state_bytes``).
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Sequence
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.files import cannot_write, require_place_for_folder, sync_folder

DATABASE = "state.sqlite"
_TABLE = "CREATE TABLE kept (number INTEGER PRIMARY KEY, content BLOB NOT NULL)"
_VERSION = 0x43470003
_OPEN = """
    PRAGMA page_size=32768;
    PRAGMA locking_mode=EXCLUSIVE;
    PRAGMA journal_mode=WAL;
    PRAGMA synchronous=FULL;
    PRAGMA wal_autocheckpoint=128;
    PRAGMA trusted_schema=OFF;
    BEGIN EXCLUSIVE;
"""
"""Large pages halve the time of a state; a log of 128 pages has 4 MB, as by default."""


class StateDatabase:
    """The state of one tracker in a folder, locked against a second process.

    Args:
        folder: where the state is kept; made if it is not there.

    Raises:
        FileError: if another process uses the folder, or its database is damaged or of another
            program.
        OSError: if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        require_place_for_folder(folder)
        new = [part for part in (folder, *folder.parents) if not part.exists()]
        folder.mkdir(parents=True, exist_ok=True)
        for part in new:
            sync_folder(part.parent)
        self._path = folder / DATABASE
        try:
            self._connection = sqlite3.connect(
                self._path, timeout=0, isolation_level=None, check_same_thread=False
            )
        except sqlite3.Error as error:
            raise cannot_write(self._path, error) from error
        try:
            is_new = self._is_new()
            self._connection.executescript(_OPEN)
            if is_new:
                self._connection.execute(_TABLE)
                self._connection.execute(f"PRAGMA user_version={_VERSION}")
            self._connection.execute("COMMIT")
        except BaseException as error:
            self.close()
            if isinstance(error, sqlite3.Error):
                raise self._unusable(error) from error
            raise

    def write(self, inputs: Sequence[bytes], state: bytes | None = None) -> None:
        """Add inputs; they are on disk when this returns, all or none.

        Args:
            inputs: in their order.
            state: replaces that of the database and all inputs so far, which led to it.

        Raises:
            OSError: if they cannot be written; what was there is safe, and all is closed.
        """
        try:
            self._connection.execute("BEGIN")
            (last,) = self._connection.execute("SELECT max(number) FROM kept").fetchone()
            if state is not None:
                self._connection.execute("DELETE FROM kept")
            contents = [state, *inputs] if state is not None else inputs
            first = 0 if last is None else last + 1
            rows = enumerate(contents, first)
            self._connection.executemany("INSERT INTO kept VALUES (?, ?)", rows)
            self._connection.execute("COMMIT")
        except BaseException as error:
            self.close()  # whether it is on disk is unknown
            if isinstance(error, sqlite3.Error):
                full = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_FULL
                number = errno.ENOSPC if full else errno.EIO
                raise cannot_write(self._path, error, number) from error
            raise

    def close(self) -> None:
        """Release the folder; nothing is left to write."""
        self._connection.close()

    def read(self) -> list[bytes]:
        """The state and the inputs after it; nothing of a new database.

        The last input may be one whose write has not returned.

        Raises:
            FileError: if it is damaged.
        """
        try:
            (state,) = self._connection.execute("PRAGMA integrity_check(1)").fetchone()
            rows = self._connection.execute("SELECT * FROM kept ORDER BY number").fetchall()
        except sqlite3.Error as error:
            raise self._unusable(error) from error
        if state != "ok":
            raise _damaged(self._path, state)
        for expected, (number, content) in enumerate(rows, rows[0][0] if rows else 0):
            if number != expected or not isinstance(content, bytes):
                raise _damaged(self._path, f"row {expected} is missing")
        return [content for _, content in rows]

    def _is_new(self) -> bool:
        """Whether there is nothing yet; the database of another is refused before it is changed."""
        schema = self._connection.execute("SELECT sql FROM sqlite_schema").fetchmany(2)
        (version,) = self._connection.execute("PRAGMA user_version").fetchone()
        if schema and (schema, version) != ([(_TABLE,)], _VERSION):
            message = "is of another program or version; choose another folder"
            raise FileError(self._path, message)
        return not schema

    def _unusable(self, error: sqlite3.Error) -> Exception:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        if code == sqlite3.SQLITE_BUSY:
            message = "is in use by another process; stop that one, or choose another folder"
            return FileError(self._path.parent, message)
        if code in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB):
            return _damaged(self._path, error)
        return cannot_write(self._path, error)


def _damaged(path: Path, why: object) -> FileError:
    advice = "restore its folder from a copy, or choose another folder"
    return FileError(path, f"is damaged ({why}); {advice}")
