"""Frames of correspondences, one at a time: from a table, a growing folder, or standard input.

Every source is pulled: nothing is read before it is asked for, beyond one chunk, so that a slow
reader slows the writer down and an endless stream needs the memory of one frame.
"""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from calibgraph.errors import FileError
from calibgraph.tracking.stream_folder import frames_of_folder
from calibgraph.tracking.stream_input import frames_of_input
from calibgraph.tracking.stream_tables import Item, Refused, StreamFrame, frames_of_table

__all__ = ["Item", "Refused", "StreamFrame", "frames_of"]


def frames_of(
    source: Path | str,
    *,
    follow: bool = False,
    stop: Callable[[], bool] = lambda: False,
    stdin: BinaryIO | None = None,
) -> Iterator[Item]:
    """The frames of a source, whatever it is; what ends it too early is the last item.

    Args:
        source: a table, a folder of tables, or "-" for standard input.
        follow: wait for new files in a folder, until ``stop()``.
        stop: asked before every frame and, while waiting, several times a second; True ends the
            frames.
        stdin: what "-" reads; standard input if None.

    Raises:
        FileError: at once, if there is no such source, or a file is to be followed.
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
        return _until(stop, frames_of_folder(path, follow=follow, stop=stop))
    if not stat.S_ISREG(mode):
        raise FileError(path, "is neither a file nor a folder; pipe it in and give '-'")
    if follow:
        raise FileError(path, "is a file, and only a folder can be followed; give its folder")
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
