"""Output for humans, all of it on stderr: plain lines, and progress as a bar or as lines."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from calibgraph.progress import Progress

_STARTED = time.monotonic()
LINE_EVERY_S = 5.0
"""The least time before the first line of progress and between two: short work is silent."""


def terminal(least_columns: int = 80) -> Console:
    """A console on stderr, on which a reader that has gone is no error; stdout is for JSON.

    What is printed can do no more than be seen: names of files and fields are those of others.
    Lines that are longer than a narrow terminal are wrapped by it: tables without names and digits
    are of no use.
    """
    from rich.console import Console
    from rich.segment import Segment

    from calibgraph.errors import printable
    from calibgraph.stdout import discard

    class Stderr(Console):
        def render(self, *arguments: Any, **options: Any) -> Iterable[Segment]:
            for segment in super().render(*arguments, **options):
                yield segment if segment.control else segment._replace(text=printable(segment.text))

        def on_broken_pipe(self) -> None:
            """Go on without output: the files and the exit code are what counts."""
            self.quiet = True
            discard(sys.stderr)

    console = Stderr(stderr=True)
    console.width = max(console.width, least_columns)
    return console


def print_line(*lines: str) -> None:
    """Print lines on stderr as they are: no markup, no colours, no line breaks of rich's own."""
    for text in lines:
        terminal().out(text, highlight=False)


def elapsed_s() -> float:
    """Seconds since the program started, by the clock on the wall."""
    return time.monotonic() - _STARTED


@contextmanager
def progress_bar(first: str = "starting") -> Iterator[Progress]:
    """Progress on stderr: a bar that is removed in the end, or lines if stderr is no terminal.

    Warnings that the work logs are printed, a line each.
    """
    console = terminal(least_columns=0)  # a bar is redrawn, and must not be wrapped
    if not console.is_terminal:
        with _printed_warnings(console):
            yield progress_lines(print_line)
        return
    from rich import progress

    shown = ("{task.description}", progress.BarColumn(), progress.TimeElapsedColumn(), "left")
    left = progress.TimeRemainingColumn()
    with progress.Progress(*shown, left, console=console, transient=True) as bar:
        task = bar.add_task(first, total=None)
        with _printed_warnings(bar.console):
            yield lambda what, done, total: bar.update(
                task, description=what, completed=done, total=total
            )


def progress_lines(
    print_line: Callable[[str], None], clock: Callable[[], float] = time.monotonic
) -> Progress:
    """A progress callback that prints a line per stage, and not more often than is readable."""
    start = printed = clock()

    def progress(what: str, done: int, total: int) -> None:
        nonlocal printed
        now = clock()
        if now - printed >= LINE_EVERY_S:
            printed = now
            print_line(f"{now - start:5.0f} s  {what}, {done} of {total}")

    return progress


@contextmanager
def _printed_warnings(console: Console) -> Iterator[None]:
    """Warnings that are logged meanwhile are printed."""

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            console.out(f"{record.levelname.lower()}: {record.getMessage()}", highlight=False)

    logger, lines = logging.getLogger("calibgraph"), Lines(logging.WARNING)
    logger.addHandler(lines)
    try:
        yield
    finally:
        logger.removeHandler(lines)
