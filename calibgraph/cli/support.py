"""What every command does around its one call: errors, terminal, progress."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibgraph.progress import Progress


@contextmanager
def checked_arguments() -> Iterator[None]:
    """Turn a wrong argument, a ``ValueError`` in the library, into the user's one line."""
    from calibgraph.errors import CalibrationError

    try:
        yield
    except ValueError as error:
        raise CalibrationError(str(error)) from error


def terminal() -> Any:
    """A console on stderr: stdout is for machines."""
    from rich.console import Console

    return Console(stderr=True)


@contextmanager
def progress_bar() -> Iterator[Progress]:
    """A progress bar on stderr, that is gone when the work is done."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    console = terminal()
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda what, done, total: bar.update(
            task, description=what, completed=done, total=total
        )
