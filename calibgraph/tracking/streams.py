"""Frames of correspondences, one at a time: from a table, or standard input.

Every source is pulled: nothing is read ahead of its use beyond one chunk, so that a slow reader
slows the writer down and an endless stream needs the memory of one frame.
"""

from __future__ import annotations

import select
import stat
import sys
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
"""How often a wait for input calls ``stop``."""

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
    stop: Callable[[], bool] = lambda: False,
    stdin: BinaryIO | None = None,
) -> Iterator[Item]:
    """The frames of a source; an error that ends it too early is the last item.

    Args:
        source: a table, or "-" for standard input.
        stop: called before every frame and, while waiting, several times a second; True ends the
            frames.
        stdin: what "-" reads; standard input if None.

    Raises:
        FileError: at once, if there is no such source, or it has a motion that no vehicle has.
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
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileError(path, "is no file; pipe it in and give '-'")
    if stat.S_ISDIR(mode) or is_bag(path):
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
