"""What can be wrong with the data (a wrong argument is a ``ValueError`` instead).

Every message is one line that says what is wrong, where, what was found and what to do.
"""

from __future__ import annotations

from pathlib import Path


class CalibrationError(Exception):
    """Data that cannot be calibrated. ``camera`` and ``frame`` say where, when that is known."""

    def __init__(
        self, message: str, *, camera: str | None = None, frame: str | int | None = None
    ) -> None:
        super().__init__(" ".join(message.split()))
        self.camera = camera
        self.frame = frame


class FileError(CalibrationError):
    """A file that is missing, truncated, or not of the format it should have."""

    def __init__(self, path: Path | str, message: str) -> None:
        super().__init__(f"{path}: {message}")
        self.path = Path(path)


class RigError(CalibrationError):
    """A rig, or a part of one, that does not make sense."""


class CorrespondenceError(CalibrationError):
    """Correspondences that are malformed, unusable or too few."""


class DatasetError(CalibrationError):
    """Images and clouds that do not fit together, or do not fit the rig."""
