"""What the routes of jobs and trackers answer."""

from datetime import UTC, datetime

from pydantic import BaseModel

from calibgraph.service.job_task import JobProgress
from calibgraph.service.jobs import JobRecord, JobState
from calibgraph.service.requests import JobKind


class JobError(BaseModel):
    """Why a job failed.

    Attributes:
        kind: bad input, io, out of memory, timeout, worker died or internal error.
        detail: what is wrong, and what to do, in one line.
    """

    kind: str
    detail: str


class JobAnswer(BaseModel):
    """A job.

    Attributes:
        id: of the job.
        kind: calibration, solve or check.
        state: queued, running, succeeded, failed or cancelled.
        created, started, finished: times (UTC); null if not yet.
        progress: of a running job.
        verdict: of the result: PASS, WARN or FAIL; of a check OK, WRONG or CANNOT TELL.
        cannot_tell: whether the data determine too little for another verdict: of a WARN that
            nothing odd was found behind, and of CANNOT TELL; null as long as there is none.
        error: of a failed job.
        name, note: that were given with it.
    """

    id: str
    kind: JobKind
    state: JobState
    created: datetime
    started: datetime | None
    finished: datetime | None
    progress: JobProgress | None
    verdict: str | None
    cannot_tell: bool | None
    error: JobError | None
    name: str
    note: str


class JobList(BaseModel):
    """Jobs, the newest first.

    Attributes:
        jobs: of this page.
        next: ``before`` of the next page; null on the last.
    """

    jobs: list[JobAnswer]
    next: int | None


def job_answer(record: JobRecord, progress: JobProgress | None) -> JobAnswer:
    """A job as an answer."""
    return JobAnswer(
        id=record.id,
        kind=record.kind,
        state=record.state,
        created=utc(record.created_s),
        started=None if record.started_s is None else utc(record.started_s),
        finished=None if record.finished_s is None else utc(record.finished_s),
        progress=progress if record.state == "running" else None,
        verdict=record.verdict,
        cannot_tell=record.cannot_tell,
        error=JobError(kind=record.error_kind or "internal error", detail=record.error)
        if record.error is not None
        else None,
        name=record.name or "",
        note=record.note or "",
    )


def utc(time_s: float) -> datetime:
    """A time since 1970."""
    return datetime.fromtimestamp(time_s, UTC)
