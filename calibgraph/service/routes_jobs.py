"""Routes of jobs: ask for one, follow it, cancel it; and what they answer."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse, StreamingResponse
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool

from calibgraph.service.access import Reader, Submitter
from calibgraph.service.jobs import JobRecord, JobState
from calibgraph.service.problems import Problem, documented, reference
from calibgraph.service.requests import (
    ABOUT,
    ALLOWED,
    LOG,
    REQUESTS,
    REQUIRED,
    SETTINGS_OF,
    JobKind,
    JobProgress,
)
from calibgraph.service.state import Service, State
from calibgraph.service.submission import SETTINGS, submit


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
        kind: calibration, solve or check.
        state: queued, running, succeeded, failed or cancelled.
        created, started, finished: times (UTC); null if not yet.
        verdict: of the result: PASS, WARN or FAIL; of a check OK, WRONG or CANNOT TELL.
        cannot_tell: whether the data determine too little for another verdict: of a WARN that
            nothing odd was found behind, and of CANNOT TELL; null as long as there is none.
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


router = APIRouter(prefix="/v1")

_PATHS: dict[JobKind, str] = {
    "calibration": "/calibrations", "solve": "/solves", "check": "/checks",
}  # fmt: skip
_LONGEST_WAIT_S = 60.0
_MOST_LOG = 2**20
_KEEP_ALIVE_S = 15.0
_LONGEST_PAUSE_S = 0.5
_NO_CACHE = {"X-Accel-Buffering": "no"}

JobId = Annotated[str, "id of a job"]
IdempotencyKey = Annotated[
    str | None,
    Header(description="A repeated request with the same key gives the job of the first."),
]


def _body(kind: JobKind) -> dict[str, Any]:
    """The bodies that a kind takes, for OpenAPI."""
    files: dict[str, Any] = {name: {"type": "string", "format": "binary"} for name in ALLOWED[kind]}
    if "recording" in files:
        files["recording"] = {"type": "array", "items": files["recording"]}
    texts = dict.fromkeys(ABOUT, {"type": "string"})
    form = {
        "type": "object",
        "properties": {**files, **texts, SETTINGS: reference(SETTINGS_OF[kind])},
        "required": list(REQUIRED[kind]),
    }
    content = {
        "application/json": {"schema": reference(REQUESTS[kind])},
        "multipart/form-data": {"schema": form},
    }
    return {"requestBody": {"required": True, "content": content}}


def _submit_route(kind: JobKind) -> Callable[..., Awaitable[Response]]:
    async def route(
        request: Request, state: State, caller: Submitter, idempotency_key: IdempotencyKey = None
    ) -> Response:
        record = await submit(state, request, caller, kind, key=idempotency_key)
        answer = job_answer(record, state.runner.step(record.id))
        headers = {"Location": f"/v1/jobs/{record.id}"}
        return JSONResponse(answer.model_dump(mode="json"), 202, headers)

    route.__doc__ = f"Ask for a {kind}: JSON with URIs, or a form with files (or URIs as fields)."
    route.__name__ = f"submit_{kind}"
    return route


for _kind in REQUESTS:
    router.post(
        _PATHS[_kind],
        status_code=202,
        response_model=JobAnswer,
        responses=documented(413, 415, 422, 429, 507),
        openapi_extra=_body(_kind),
    )(_submit_route(_kind))


def find_job(state: Service, caller: Reader, id: str) -> JobRecord:
    """The job of an id."""
    record = state.jobs.get(id, caller)
    if record is None:
        raise no_such_job()
    return record


def no_such_job() -> Problem:
    """The answer for an id that is not known, or no more."""
    return Problem(404, "no such job; finished jobs are removed after some time")


@router.get("/jobs", responses=documented(422))
def list_jobs(
    state: State,
    caller: Reader,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    before: Annotated[int | None, Query(ge=0, le=2**62)] = None,
) -> JobList:
    """The jobs of the tenant, the newest first."""
    records = state.jobs.newest(caller, limit, before)
    following = records[-1].number if len(records) == limit else None
    return JobList(jobs=[job_answer(r, state.runner.step(r.id)) for r in records], next=following)


@router.get("/jobs/{id}", responses=documented(404, 422))
async def get_job(
    id: JobId,
    state: State,
    caller: Reader,
    wait_s: Annotated[float, Query(ge=0, le=_LONGEST_WAIT_S)] = 0.0,
) -> JobAnswer:
    """A job; with ``wait_s`` the answer waits until it is finished, not longer than that."""
    start = time.monotonic()
    while True:
        record = await run_in_threadpool(find_job, state, caller, id)
        waited_s = time.monotonic() - start
        if record.is_finished or waited_s >= wait_s or state.is_stopping:
            return job_answer(record, state.runner.step(id))
        await asyncio.sleep(min(_pause_s(waited_s), wait_s - waited_s))


def _pause_s(waited_s: float) -> float:
    """Until a job is looked at again: short ones are seen at once, long ones cost little."""
    return min(_LONGEST_PAUSE_S, 0.02 + waited_s / 10)


@router.get(
    "/jobs/{id}/events",
    response_class=StreamingResponse,
    responses={**documented(404, 422), 200: {"content": {"text/event-stream": {}}}},
)
async def job_events(id: JobId, state: State, caller: Reader) -> Response:
    """The job, as server-sent events: now, on every change, and when it is finished."""
    await run_in_threadpool(find_job, state, caller, id)
    return StreamingResponse(
        _events(state, caller, id), media_type="text/event-stream", headers=_NO_CACHE
    )


async def _events(state: Service, caller: Reader, id: str) -> AsyncIterator[str]:
    sent, start = "", time.monotonic()
    last_s = start
    while not state.is_stopping:
        record = await run_in_threadpool(state.jobs.get, id, caller)
        if record is None:
            return
        text = json.dumps(job_answer(record, state.runner.step(id)).model_dump(mode="json"))
        if text != sent:
            yield f"event: {record.state}\ndata: {text}\n\n"
            sent, last_s = text, time.monotonic()
        elif time.monotonic() - last_s > _KEEP_ALIVE_S:
            yield ": still here\n\n"
            last_s = time.monotonic()
        if record.is_finished:
            return
        await asyncio.sleep(_pause_s(time.monotonic() - start))


@router.get(
    "/jobs/{id}/log",
    response_class=PlainTextResponse,
    responses={**documented(404, 422), 200: {"content": {"text/plain": {}}}},
)
def job_log(id: JobId, state: State, caller: Reader) -> Response:
    """What the job printed: its last part."""
    find_job(state, caller, id)
    folder = state.folder.of_job(id)
    try:
        text = (folder / LOG).read_bytes()[-_MOST_LOG:].decode(errors="replace")
    except FileNotFoundError:
        text = ""
    return PlainTextResponse(text.replace(str(folder), "").replace(str(state.folder.path), ""))


@router.delete("/jobs/{id}", responses=documented(404, 409, 422))
def cancel_job(id: JobId, state: State, caller: Submitter) -> JobAnswer:
    """Cancel a job that waits or runs."""
    find_job(state, caller, id)
    if not state.runner.cancel(id):
        raise Problem(409, "the job is finished")
    return job_answer(find_job(state, caller, id), None)
