"""A tracker whose every update is on disk when it returns.

An SQLite database has the state in its first row, then the inputs since. With a write-ahead log and
``synchronous=FULL``, rows are on disk when their transaction returns, and a crash leaves all of it
or none. What rows hold has a checksum of its own (``calibgraph.tracking.state_bytes``).
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Self

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import cannot_write, require_place_for_folder, sync_to_disk
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.frames import StreamFrame, as_kept, frame_of
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.tracker import IncrementalCalibrator, Outcome

DATABASE = "state.sqlite"
_STATE_EVERY = 50  # updates, of which a restart repeats up to so many and those of one write
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


class DurableCalibrator:
    """An :class:`IncrementalCalibrator` that survives ``kill -9`` at any moment.

    An update that has returned is on disk. After a restart, the next update gives the same numbers
    as without the restart.

    Attributes:
        tracker: the calibrator that is kept on disk.
        resumed: whether there was a state to continue from.
        repeated: after a crash, the updates of the last write, which may not have returned then.

    Args:
        folder: where the state is kept; one process at a time.
        rig: cameras with their initial guess.
        config: settings; the preset ``auto`` if None.

    Raises:
        FileError: if another process uses the folder, or the state in it is damaged, of another
            version, another rig or other settings.
    """

    def __init__(self, folder: Path | str, rig: Rig, config: Config | None = None) -> None:
        folder = Path(folder)
        self._database = StateDatabase(folder)
        self.tracker: IncrementalCalibrator
        self.repeated: list[Update] = []
        self._since = 0  # updates since the state that is on disk
        try:
            if rows := self._database.read():
                self._resume(folder, *rows)
                _require_same(folder, self.tracker, rig, config or Config())
            else:
                self.tracker = IncrementalCalibrator(rig, config)
                self._database.write([], self.tracker.to_bytes())
        except BaseException:
            self.abandon()
            raise
        self.resumed = self.tracker.frame is not None

    def _resume(self, folder: Path, state: bytes, *inputs: bytes) -> None:
        """Go on from a state, with the inputs after it as they were taken in together."""
        try:
            self.tracker = IncrementalCalibrator.from_bytes(state)
            for row in inputs:
                groups = decode(row, tuple)
                updates = [self.tracker.update_together(group) for group in groups]
                if [*map(len, updates)] != [*map(len, groups)]:
                    raise StateError("frames of one input do not go together")
                self.repeated = [*chain.from_iterable(updates)]
                self._since += len(self.repeated)
        except (StateError, CorrespondenceError) as error:
            advice = "choose another folder, or restore it from a copy"
            raise FileError(
                folder, f"holds a state that is damaged or of another version ({error}); {advice}"
            ) from error

    def update(
        self, table: Correspondences, *, frame: int | None = None, place: str | int | None = None
    ) -> Update:
        """Take in one frame, see :meth:`IncrementalCalibrator.update`; it is on disk then.

        Raises:
            CorrespondenceError: as there. Nothing has changed then.
            OSError: if it cannot be written; then close this, and make a new one.
        """
        (found,) = self.update_all([frame_of(table, frame, place)])
        if isinstance(found, CorrespondenceError):
            raise found
        return found[0]

    def update_all(self, frames: Sequence[StreamFrame]) -> list[Outcome]:
        """As :meth:`IncrementalCalibrator.update_all`; all are on disk then, by one write.

        Raises:
            OSError: if they cannot be written; then close this, and make a new one.
        """
        state = self.tracker.to_bytes() if self._since >= _STATE_EVERY else None
        found, left, groups = [*self.tracker.update_all(frames)], iter(frames), []
        for one in found:
            if isinstance(one, CorrespondenceError):
                next(left)
            else:
                groups.append(tuple(as_kept(next(left)) for _ in one))
        if groups:
            self._database.write([encode(tuple(groups))], state)
            self._since = sum(map(len, groups)) + (0 if state else self._since)
        return found

    def close(self) -> None:
        """Write the state and release the folder: a restart has nothing to repeat."""
        try:
            self._database.write([], self.tracker.to_bytes())
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Release the folder without the state: the inputs of all updates that returned are there.

        For a tracker that may be in the middle of an update, as after an error.
        """
        self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close() if kind is None else self.abandon()


def _require_same(folder: Path, tracker: IncrementalCalibrator, rig: Rig, config: Config) -> None:
    """The state in a folder must be of the same cameras and the same settings."""
    if _without_guess(tracker.initial_rig) != _without_guess(rig):
        raise FileError(
            folder,
            "holds the state of another rig (names, lenses, sizes or relative poses differ); "
            "choose another folder",
        )
    if tracker.config != config:
        differing = "; ".join(_differences(tracker.config.model_dump(), config.model_dump()))
        raise FileError(
            folder,
            f"holds a state made with other settings ({differing}); take these or another folder",
        )


def _differences(held: Mapping[str, Any], given: Mapping[str, Any]) -> Iterator[str]:
    """The settings that differ, with both values."""
    for key, value in given.items():
        if isinstance(value, dict):
            yield from _differences(held[key], value)
        elif held[key] != value:
            yield f"{key} {held[key]}, given {value}"


def _without_guess(rig: Rig) -> dict[str, object]:
    content = rig.model_dump(mode="json")
    for camera in content["cameras"].values():
        del camera["T_camera_lidar"]
    return content


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
            sync_to_disk(part.parent)
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
        contents, execute = [*inputs], self._connection.execute
        try:
            execute("BEGIN")
            if state is not None:
                execute("DELETE FROM kept")
                contents.insert(0, state)
            rows = ((content,) for content in contents)
            self._connection.executemany("INSERT INTO kept (content) VALUES (?)", rows)
            execute("COMMIT")
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
            rows = self._connection.execute("SELECT content FROM kept ORDER BY number").fetchall()
        except sqlite3.Error as error:
            raise self._unusable(error) from error
        if state != "ok":
            raise _damaged(self._path, state)
        return [content for (content,) in rows]

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
