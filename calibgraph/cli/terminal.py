"""Output for humans, all of it on stderr: plain lines and a progress bar."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

    from calibgraph.progress import Progress


def terminal() -> Console:
    """A console on stderr, on which a reader that has gone is no error; stdout is for JSON."""
    from rich.console import Console

    class Stderr(Console):
        def on_broken_pipe(self) -> None:
            """Go on without output: the files and the exit code are what counts."""
            self.quiet = True
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())

    return Stderr(stderr=True)


def print_plain(console: Console, text: str) -> None:
    """Print a line as it is: no markup, no colours, no line breaks of rich's own."""
    console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def progress_bar(first: str = "starting") -> Iterator[Progress]:
    """A progress bar on stderr, removed when the work is done; none if stderr is no terminal.

    Warnings that the work logs are printed, a line each.

    Args:
        first: description until the callback is called for the first time.
    """
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = terminal()
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(first, total=None)
        logger, lines = logging.getLogger("calibgraph"), _WarningLines(bar.console)
        logger.addHandler(lines)
        try:
            yield lambda what, done, total: bar.update(
                task, description=what, completed=done, total=total
            )
        finally:
            logger.removeHandler(lines)


class _WarningLines(logging.Handler):
    """Prints warnings as lines above a progress bar."""

    def __init__(self, console: Console) -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        """Print one."""
        print_plain(self._console, f"{record.levelname.lower()}: {record.getMessage()}")
