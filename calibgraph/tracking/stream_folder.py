"""Frames of correspondences from a folder of tables, which may be growing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from calibgraph.errors import FileError
from calibgraph.tracking.stream_tables import Item, Refused, frames_of_table

POLL_S = 0.2
"""How often a followed folder is looked at."""

QUIET_S = 2.0
"""A file that has not changed for so long is complete, or will never be."""


def frames_of_folder(folder: Path, *, follow: bool, stop: Callable[[], bool]) -> Iterator[Item]:
    """The frames of a folder's ``*.parquet`` and ``*.csv``, in the order of the files' names.

    Hidden files are ignored: a table is best written under a hidden name and then renamed. With
    ``follow`` a file that cannot be read is tried again until it has not changed for ``QUIET_S``,
    and a CSV is not read before, since nothing in it says that it is complete.

    Args:
        folder: of tables, each of one or several frames.
        follow: wait for new files; each is read once, even if its name sorts before one read.
        stop: asked every ``POLL_S``; True ends the frames.

    Raises:
        FileError: when the folder cannot be read any more.
    """
    tables = _Tables(folder, follow=follow)
    while not stop():
        for path in tables.unread():
            yield from tables.read(path)
        if not follow:
            return
        time.sleep(POLL_S)


class _Tables:
    """Which tables of a folder have been read, and which are still being written."""

    def __init__(self, folder: Path, *, follow: bool) -> None:
        self._folder = folder
        self._follow = follow
        self._read: set[str] = set()
        self._changed: dict[str, tuple[object, float]] = {}

    def unread(self) -> list[Path]:
        """Tables not read yet, by name; what is no longer there is forgotten."""
        try:
            names = {path.name for path in self._folder.iterdir() if _is_table_name(path)}
        except OSError as error:
            message = f"the folder cannot be read any more ({error}); restart"
            raise FileError(self._folder, message) from error
        self._read &= names
        self._changed = {name: seen for name, seen in self._changed.items() if name in names}
        return [self._folder / name for name in sorted(names - self._read)]

    def read(self, path: Path) -> Iterator[Item]:
        """The frames of a table; none as long as it may still be being written."""
        quiet = not self._follow or self._quiet_s(path) >= QUIET_S
        if path.suffix == ".csv" and not quiet:
            return
        begun = False
        try:
            for item in frames_of_table(path):
                begun = True
                yield item
        except FileError as error:
            if not (begun or quiet):
                return
            yield Refused(str(error))
        self._read.add(path.name)

    def _quiet_s(self, path: Path) -> float:
        """For how long a file has not changed, by its own time or as far as was seen here."""
        now, age_s, state = time.monotonic(), 0.0, None
        try:
            status = path.stat()
            age_s, state = time.time() - status.st_mtime, (status.st_size, status.st_mtime_ns)
        except OSError:
            pass  # A link to nothing stays so for QUIET_S and is then refused by name.
        if path.name not in self._changed or self._changed[path.name][0] != state:
            self._changed[path.name] = (state, now)
        return max(age_s, now - self._changed[path.name][1])


def _is_table_name(path: Path) -> bool:
    return path.suffix in (".parquet", ".csv") and not path.name.startswith(".")
