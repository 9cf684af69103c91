"""Frames of correspondences, one at a time: from a table, a growing folder, or standard input.

Every source is pulled: nothing is read ahead of its use beyond one chunk, so that a slow reader
slows the writer down and an endless stream needs the memory of one frame.
"""

from __future__ import annotations

import select
import stat
import sys
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import BinaryIO

from calibgraph.errors import FileError
from calibgraph.io.bags.storage import is_bag
from calibgraph.tracking.stream_lines import frames_of_lines
from calibgraph.tracking.stream_tables import (
    Item,
    Refused,
    StreamFrame,
    frames_of_table,
    require_plausible_motion,
)

__all__ = ["Item", "Refused", "StreamFrame", "frames_of"]

POLL_S = 0.2
"""How often a followed folder is read, and how often a wait for input calls ``stop``."""

QUIET_S = 2.0
"""A file that has not changed for this long is complete, or will never be."""

_CHUNK_BYTES = 2**16
_STANDARD_INPUT = "standard input"
_DATASET = "to track a dataset, say what matches its frames: --matcher structure"
_NOT_LINES = {
    b"PAR1": "a Parquet file",
    b"ARROW1": "an Arrow file",
    b"\xff\xff\xff\xff": "an Arrow stream",
    b"\xff\xfe": "text in UTF-16, as PowerShell pipes it, expected UTF-8",
}


def frames_of(
    source: Path | str,
    *,
    follow: bool = False,
    stop: Callable[[], bool] = lambda: False,
    stdin: BinaryIO | None = None,
) -> Iterator[Item]:
    """The frames of a source; an error that ends it too early is the last item.

    Args:
        source: a table, a folder of tables, or "-" for standard input.
        follow: wait for new files in a folder, until ``stop()``.
        stop: called before every frame and, while waiting, several times a second; True ends the
            frames.
        stdin: what "-" reads; standard input if None.

    Raises:
        FileError: at once, if there is no such source, a file is to be followed, or a file has a
            motion that no vehicle has.
    """
    if str(source) == "-":
        if stdin is None and sys.stdin is None:
            raise FileError("standard input", "is closed; pipe frames in")
        return _until(stop, frames_of_input(stdin or sys.stdin.buffer, stop=stop))
    path = Path(source)
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read ({error}); check the path") from error
    if stat.S_ISDIR(mode):
        tables = [one for one in sorted(path.iterdir()) if _is_table_name(one)]
        if not (tables or follow):
            raise FileError(path, f"holds no table of correspondences; {_DATASET}")
        for table in tables if not follow else ():
            require_plausible_motion(table)
        return _until(stop, frames_of_folder(path, follow=follow, stop=stop))
    if not stat.S_ISREG(mode):
        raise FileError(path, "is neither a file nor a folder; pipe it in and give '-'")
    if follow:
        raise FileError(path, "is a file, and only a folder can be followed; give its folder")
    if is_bag(path):
        raise FileError(path, f"is no table of correspondences; {_DATASET}")
    require_plausible_motion(path)
    return _until(stop, frames_of_table(path))


def _until(stop: Callable[[], bool], items: Iterator[Item]) -> Iterator[Item]:
    try:
        for item in items:
            if stop():
                return
            yield item
    except FileError as error:
        if not stop():
            yield Refused(str(error))


# A folder of tables


def frames_of_folder(folder: Path, *, follow: bool, stop: Callable[[], bool]) -> Iterator[Item]:
    """The frames of a folder's ``*.parquet`` and ``*.csv``, in the order of the files' names.

    Hidden files are ignored: a table is best written under a hidden name and then renamed. With
    ``follow`` a file that cannot be read is tried again until it has not changed for ``QUIET_S``,
    and a CSV is not read before, since nothing in it shows that it is complete.

    Args:
        folder: of tables, each of one or several frames.
        follow: wait for new files; each is read once, even if its name sorts before one read.
        stop: called every ``POLL_S``; True ends the frames.

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
        """Tables not read yet, by name; removed ones are forgotten."""
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
        """For how long a file has not changed, by its own time stamp or by observation."""
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


# Standard input


def frames_of_input(file: BinaryIO, *, stop: Callable[[], bool]) -> Iterator[Item]:
    """The frames of JSON lines.

    Args:
        file: for example standard input: if it has a descriptor, waiting for it can be stopped.
        stop: called while waiting, every ``POLL_S``; True ends the input.

    Raises:
        FileError: if the stream turns out not to be readable.
    """
    chunks = _chunks(file, stop)
    first = next(chunks, b"")
    while any(len(first) < len(mark) and mark.startswith(first) for mark in _NOT_LINES):
        if not (more := next(chunks, b"")):
            break
        first += more
    for mark, kind in _NOT_LINES.items():
        if first.startswith(mark):
            raise FileError(_STANDARD_INPUT, f"is {kind}; send a line of JSON per frame")
    yield from frames_of_lines(chain([first], chunks), _STANDARD_INPUT)


def _chunks(file: BinaryIO, stop: Callable[[], bool]) -> Iterator[bytes]:
    """The bytes of a file as they come, until it ends or is to be stopped."""
    read: Callable[[int], bytes | None] = getattr(file, "read1", file.read)
    ready = _poll(file)
    while not stop():
        if ready is not None and not ready.poll(1000 * POLL_S):
            continue
        try:
            some = read(_CHUNK_BYTES)
        except (OSError, ValueError) as error:
            raise FileError(_STANDARD_INPUT, f"cannot be read ({error}); restart") from error
        if some:
            yield some
        elif some is not None:
            return


def _poll(file: BinaryIO) -> select.poll | None:
    """A poll object for a file, or None if reading it never waits."""
    try:
        descriptor = file.fileno()
    except (OSError, ValueError):  # Bytes in memory, or closed.
        return None
    ready = select.poll()
    ready.register(descriptor, select.POLLIN)
    return ready
