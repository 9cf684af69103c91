"""What a worker gets and what it returns: a job with its limits, and the job's outcome."""

import traceback
from dataclasses import dataclass
from typing import Literal

from calibgraph.errors import CalibrationError
from calibgraph.fleet.manifest import Job
from calibgraph.model.config import Reported
from calibgraph.model.versions import version_of

ErrorKind = Literal[
    "bad input", "io", "out of memory", "timeout", "worker died", "internal error"
]  # fmt: skip


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


RETRIES: dict[ErrorKind, int] = {
    "bad input": 0,
    "io": 3,
    "out of memory": 0,
    "timeout": 1,
    "worker died": 3,
    "internal error": 0,
}
"""How often a job is tried again in one run. A later run tries all failures again but bad input."""


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
class Task:
    """One try of a job, made by this release of the package."""

    job: Job
    limits: Limits
    release: str


@dataclass(frozen=True)
class CameraResult:
    """The result of one camera, as its row holds it."""

    camera: str
    verdict: str
    cannot_tell: bool
    probability_off: float | None
    reasons: tuple[str, ...]
    T_camera_lidar: tuple[float, ...]
    covariance: tuple[float, ...] | None
    actions: tuple[str, ...] = ()
    of: Reported = "alignment"


@dataclass(frozen=True)
class Outcome:
    """How a try ended; without versions its process died."""

    cameras: tuple[CameraResult, ...] = ()
    error_kind: ErrorKind | None = None
    error: str | None = None
    seconds: float = 0.0
    versions: str = ""
    log: str = ""


def release() -> str:
    """The version of this package."""
    return version_of("calibgraph")
