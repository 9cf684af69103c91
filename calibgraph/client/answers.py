"""What a server answers, as values, and what it refuses, as errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calibgraph.errors import CalibrationError


class ServerError(CalibrationError):
    """A request that the server refused, or a server that does not answer.

    Attributes:
        status: of HTTP; None without an answer.
        retry_after_s: when to try again; None if that is not known.
    """

    def __init__(
        self, message: str, status: int | None = None, retry_after_s: float | None = None
    ) -> None:
        super().__init__(message)
        self.status, self.retry_after_s = status, retry_after_s


@dataclass(frozen=True)
class RemoteJob:
    """A job of a server.

    Attributes:
        id: of the job.
        kind: calibration, solve or check.
        state: queued, running, succeeded, failed or cancelled.
        stage, done, total: how far it is, while it runs.
        verdict: of the result; None as long as there is none.
        cannot_tell: whether the data determine too little for another one; None if unknown.
        error: why it failed, in one line.
        name, note: that were given with it.
    """

    id: str
    kind: str
    state: str
    stage: str = ""
    done: int = 0
    total: int = 0
    verdict: str | None = None
    cannot_tell: bool | None = None
    error: str | None = None
    name: str = ""
    note: str = ""

    @property
    def is_finished(self) -> bool:
        """Whether its state is final."""
        return self.state not in ("queued", "running")


def job_of(answer: Mapping[str, Any]) -> RemoteJob:
    """The job in an answer."""
    progress, error = answer.get("progress") or {}, answer.get("error") or {}
    return RemoteJob(
        id=answer["id"],
        kind=answer["kind"],
        state=answer["state"],
        stage=progress.get("stage", ""),
        done=progress.get("done", 0),
        total=progress.get("total", 0),
        verdict=answer.get("verdict"),
        cannot_tell=answer.get("cannot_tell"),
        error=error.get("detail"),
        name=answer.get("name", ""),
        note=answer.get("note", ""),
    )


def require_success(job: RemoteJob) -> RemoteJob:
    """The job, if it has a result."""
    if job.state == "succeeded":
        return job
    raise CalibrationError(job.error or f"the job was {job.state}")
