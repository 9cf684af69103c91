"""Standard output, which is for programs: JSON, a document or a line each."""

import json
import math
import os
import sys
from contextlib import suppress
from typing import Any, TextIO

from calibgraph.errors import FileError


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON document on stdout; a reader that has gone is no error."""
    with suppress(BrokenPipeError):
        print_line(json.dumps(finite(content), indent=2, allow_nan=False))


def print_line(text: str) -> None:
    """Print a line on stdout at once.

    Raises:
        BrokenPipeError: if the reader has closed the pipe.
        FileError: if it cannot be written.
    """
    try:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()
    except OSError as error:
        discard(sys.stdout)
        if isinstance(error, BrokenPipeError):
            raise
        what = f"cannot be written to ({error.strerror}); restart"
        raise FileError("standard output", what) from error


def require_stdout(wanted: bool = True) -> bool:
    """Check, before hours of work, that there is a standard output, if it is wanted."""
    if wanted and sys.stdout is None:
        raise FileError("standard output", "is closed; give what is printed somewhere to go")
    return wanted


def discard(stream: TextIO) -> None:
    """Discard what else is written: Python would write it at its exit, and report the error."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def finite(value: Any) -> Any:
    """Replace NaN and infinity, which JSON does not have, by None, inside dicts and lists too."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
