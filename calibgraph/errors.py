"""Errors of the data (a wrong argument is a ``ValueError`` instead).

Every message is one line: what is wrong, where, what was found and what to do.
"""

from __future__ import annotations

import tokenize
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_WORDS: dict[type[Exception] | tuple[type[Exception], ...], str] = {
    MemoryError: "it needs more memory than there is",
    RecursionError: "it is nested too deeply",
    OverflowError: "a number in it is too large",
    (SyntaxError, tokenize.TokenError): "its header cannot be read",
    (LookupError, AttributeError, TypeError, AssertionError): "a part of it is missing or damaged",
    EOFError: "it ends too early",
}
"""What errors of libraries mean where a file is read: their own texts are about code."""

MAX_MESSAGE = 2000
"""Characters of a message: it may quote a file, and a quote may be long."""


class CalibrationError(Exception):
    """Data that cannot be calibrated, at ``camera`` and ``frame`` (None if at no single one)."""

    def __init__(
        self, message: str, *, camera: str | None = None, frame: str | int | None = None
    ) -> None:
        text = " ".join(message.split())  # in one line
        super().__init__(printable(f"{text[:MAX_MESSAGE]}..." if text[MAX_MESSAGE:] else text))
        self.camera = camera
        self.frame = frame


def printable(text: str) -> str:
    """A text of others, for a terminal or a page; its lines stay.

    Characters that are not seen but do something (of control, of direction) are escaped.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in "\t\n" else ascii(c)[1:-1] for c in text)


def in_words(error: BaseException) -> str:
    """Why a file cannot be read, for people, by the error of a library."""
    for kinds, words in _WORDS.items():
        if isinstance(error, kinds):
            return words
    return getattr(error, "strerror", None) or str(error) or "it is damaged"


@contextmanager
def needs_extra(extra: str, what: str) -> Iterator[None]:
    """Within, packages of an optional extra are imported, which ``what`` names with their use.

    Raises:
        CalibrationError: if one is missing.
    """
    try:
        yield
    except ImportError as error:
        install = f"pip install 'calibgraph[{extra}]'"
        raise CalibrationError(f"{what}: {install} ({error})") from error


class FileError(CalibrationError):
    """A file that is missing, truncated, or not of the format it should have."""

    def __init__(self, path: Path | str, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = Path(path)


class RigError(CalibrationError):
    """A rig, or a part of one, that is inconsistent."""


class CorrespondenceError(CalibrationError):
    """Correspondences that are malformed, unusable or too few; ``row`` is None if not one row."""

    def __init__(
        self,
        message: str,
        *,
        camera: str | None = None,
        frame: str | int | None = None,
        row: int | None = None,
    ) -> None:
        owner = "" if camera is None else f" (camera {camera!r}, frame {frame})"
        where = "" if row is None else f"row {row}{owner}: "
        super().__init__(where + message, camera=camera, frame=frame)
        self.row = row
        self._message = message

    @property
    def without_row(self) -> str:
        """The message for those who gave lists per camera, whose number in the table is unseen."""
        return str(self) if self.row is None else f"camera {self.camera!r}: {self._message}"


class MotionError(CorrespondenceError):
    """A motion that no vehicle has: it is of another unit or order, also where it is slower."""


class DatasetError(CalibrationError):
    """Images and clouds that do not fit together, or do not fit the rig."""
