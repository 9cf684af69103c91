"""The limits of a job, and its outcome."""

import traceback
from dataclasses import dataclass
from typing import Any, Literal

from calibgraph.errors import CalibrationError
from calibgraph.model.calibration import version_of

ErrorKind = Literal["bad input", "io", "out of memory", "timeout", "worker died", "internal error"]


def describe_failure(error: Exception) -> tuple[ErrorKind, str]:
    """The kind of a job's failure, and its text: wrong data are no fault of the machine's."""
    if isinstance(error, MemoryError):
        why = f" ({error})" if str(error) else ""
        return "out of memory", f"not enough memory{why}; give fewer frames, or more --memory-gb"
    if isinstance(error, (CalibrationError, ValueError)):
        return "bad input", str(error)
    traceback.print_exception(error)
    if isinstance(error, OSError):
        return "io", str(error)
    return "internal error", f"{type(error).__name__}: {error}"


@dataclass(frozen=True)
class Limits:
    """Limits of one job.

    Attributes:
        timeout_s: wall time, with fetching.
        memory_bytes: that the job may allocate; None: no limit.
        fetch_bytes: of remote recordings that are copied to the worker's disk.
    """

    timeout_s: float = 3600.0
    memory_bytes: int | None = None
    fetch_bytes: float = 50e9


@dataclass(frozen=True)
class Outcome:
    """How a job ended: the cells of a row per camera, or an error."""

    cameras: tuple[dict[str, Any], ...] = ()
    error_kind: ErrorKind | None = None
    error: str | None = None
    seconds: float = 0.0
    log: str = ""


def release() -> str:
    """The version of this package."""
    return version_of("calibgraph")
