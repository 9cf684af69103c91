"""What can be wrong with the data (a wrong argument is a ``ValueError`` instead).

Every message is one line that says what is wrong, where, what was found and what to do.
"""

from __future__ import annotations

from pathlib import Path

MAX_MESSAGE = 2000
"""Characters of a message; what a file says of itself may be longer."""


class CalibrationError(Exception):
    """Data that cannot be calibrated. ``camera`` and ``frame`` say where, when that is known."""

    def __init__(
        self, message: str, *, camera: str | None = None, frame: str | int | None = None
    ) -> None:
        super().__init__(_one_line(message))
        self.camera = camera
        self.frame = frame


def _one_line(message: str) -> str:
    """The message without line breaks and control characters, and of a readable length."""
    text = " ".join(message.split())
    if len(text) > MAX_MESSAGE:
        text = f"{text[:MAX_MESSAGE]}..."
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class FileError(CalibrationError):
    """A file that is missing, truncated, or not of the format it should have."""

    def __init__(self, path: Path | str, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = Path(path)


class RigError(CalibrationError):
    """A rig, or a part of one, that does not make sense."""


class CorrespondenceError(CalibrationError):
    """Correspondences that are malformed, unusable or too few; of which ``row``, if it is one."""

    def __init__(
        self,
        message: str,
        *,
        camera: str | None = None,
        frame: str | int | None = None,
        row: int | None = None,
    ) -> None:
        whose = "" if camera is None else f" (camera {camera!r}, frame {frame})"
        where = "" if row is None else f"row {row}{whose}: "
        super().__init__(where + message, camera=camera, frame=frame)
        self.row = row
        self._message = message

    def after(self, rows: int) -> CorrespondenceError:
        """The same error of a longer table, which has so many rows before these."""
        row = None if self.row is None else rows + self.row
        return CorrespondenceError(self._message, camera=self.camera, frame=self.frame, row=row)


class DatasetError(CalibrationError):
    """Images and clouds that do not fit together, or do not fit the rig."""
