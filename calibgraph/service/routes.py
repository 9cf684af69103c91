"""Routes of jobs, their forms and results, of trackers, the page and health."""

import asyncio
import secrets
import shutil
import time
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse, Response
from pydantic import BaseModel, StringConstraints, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from calibgraph.files import describe
from calibgraph.model.result_files import REPORT_FILE
from calibgraph.report.kit import page_template
from calibgraph.service.jobs import JobRecord
from calibgraph.service.problems import Problem
from calibgraph.service.requests import (
    ARCHIVE,
    FILES,
    INPUT,
    LOG,
    MAX_RECORDINGS,
    PARTS,
    RECORDING,
    RESULT,
    RIG,
    SETTINGS_OF,
    SUMMARY,
    TABLE,
    TEXTS,
    Job,
    JobKind,
    recording_name,
)
from calibgraph.service.state import Service, service_of

State = Annotated[Service, Depends(service_of)]
Before = Annotated[int | None, Query(ge=0, le=2**62)]
TrackerName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}$")]
router = APIRouter()

REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
"""The report is one file with its own styles: it may do nothing else, and is of no origin."""

_LONGEST_WAIT_S = 60.0
_LONGEST_PAUSE_S = 0.5
_MOST_LOG = 2**20
_MOST_TEXT_BYTES = 10**6


class JobList(BaseModel):
    """Jobs, the newest first; ``next`` is ``before`` of the next page, null on the last."""

    jobs: list[JobRecord]
    next: int | None


def _answer(record: JobRecord, state: Service) -> JobRecord:
    return record.model_copy(update={"progress": state.steps.get(record.id)})


_FILE = {"type": "string", "format": "binary"}
_PARTS = {RIG: _FILE, TABLE: _FILE, RECORDING: {"type": "array", "items": _FILE}}
_FORM = {"type": "object", "properties": _PARTS | dict.fromkeys(TEXTS, {"type": "string"})}


@router.post(
    "/v1/jobs/{kind}",
    status_code=202,
    openapi_extra={"requestBody": {"content": {"multipart/form-data": {"schema": _FORM}}}},
)
async def submit(kind: JobKind, request: Request, response: Response, state: State) -> JobRecord:
    """Ask for a job: a form with files, and settings as JSON."""
    size = int(request.headers.get("content-length", "0"))
    await run_in_threadpool(state.require_turn, size)
    record = await _receive_job(request, kind, state)
    response.headers["Location"] = f"/v1/jobs/{record.id}"
    return _answer(record, state)


async def _receive_job(request: Request, kind: JobKind, state: Service) -> JobRecord:
    """Read the form of a job, and add the job."""
    if not request.headers.get("content-type", "").startswith("multipart/form-data"):
        raise Problem(415, "send a form: multipart/form-data")
    most = {"max_files": MAX_RECORDINGS + 2, "max_fields": MAX_RECORDINGS + 5}
    try:
        async with request.form(**most, max_part_size=_MOST_TEXT_BYTES) as form:
            return await run_in_threadpool(_add, form, kind, state)
    except LookupError as error:
        raise Problem(400, f"the form cannot be read ({error})") from error


def _add(form: FormData, kind: JobKind, state: Service) -> JobRecord:
    """Add a job whose folder has the files of a form."""
    arriving = state.arriving / secrets.token_hex(16)
    (arriving / INPUT).mkdir(parents=True, mode=0o700)
    try:
        job = _job_of(form, kind, arriving / INPUT)
        (arriving / LOG).touch()
        return state.add(arriving, job)
    finally:
        shutil.rmtree(arriving, ignore_errors=True)


def _job_of(form: FormData, kind: JobKind, folder: Path) -> Job:
    """The job of a form; files are written, texts are settings or words for people."""
    texts, counts = dict[str, str](), dict[str, int]()
    for name, value in form.multi_items():
        if name in TEXTS and isinstance(value, str):
            texts[name] = value
            continue
        if name not in PARTS[kind]:
            known = ", ".join((*PARTS[kind], *TEXTS))
            raise Problem(422, f"unknown field {name[:60]!r}; known are {known}")
        count = counts[name] = counts.get(name, 0) + 1
        if count > (MAX_RECORDINGS if name == RECORDING else 1):
            raise Problem(422, f"{name!r} is given {count} times")
        target = recording_name(count - 1) if name == RECORDING else name
        if not isinstance(value, UploadFile):
            raise Problem(422, f"{name!r} is a text; send it as a file")
        with (folder / target).open("xb") as file:
            shutil.copyfileobj(value.file, file, 2**20)
    for name, is_required in PARTS[kind].items():
        if is_required and name not in counts:
            raise Problem(422, f"{name!r} is missing; add it as a file")
    try:
        settings = SETTINGS_OF[kind].model_validate_json(texts.pop("settings", "") or "{}")
        recordings, kept = counts.get(RECORDING, 0), settings.model_dump(mode="json")
        return Job(kind=kind, recordings=recordings, settings=kept, **texts)
    except ValidationError as error:
        raise Problem(422, describe(error)) from error


@router.get("/v1/jobs")
def list_jobs(
    state: State,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    before: Before = None,
) -> JobList:
    """The jobs, the newest first."""
    records = state.jobs.newest(limit, before)
    following = records[-1].number if len(records) == limit else None
    return JobList(jobs=[_answer(record, state) for record in records], next=following)


def _found(state: Service, id: str) -> JobRecord:
    record = state.jobs.get(id)
    if record is None:
        raise Problem(404, "no such job; finished jobs are removed after some time")
    return record


@router.get("/v1/jobs/{id}")
async def get_job(
    id: str, state: State, wait_s: Annotated[float, Query(ge=0, le=_LONGEST_WAIT_S)] = 0.0
) -> JobRecord:
    """A job; with ``wait_s`` the answer waits until it is finished, not longer than that."""
    start = time.monotonic()
    while True:
        record = await run_in_threadpool(_found, state, id)
        waited_s = time.monotonic() - start
        if record.is_finished or waited_s >= wait_s or state.is_stopping:
            return _answer(record, state)
        pause_s = min(_LONGEST_PAUSE_S, 0.02 + waited_s / 10)  # short jobs are seen at once
        await asyncio.sleep(min(pause_s, wait_s - waited_s))


@router.delete("/v1/jobs/{id}")
def cancel_job(id: str, state: State) -> JobRecord:
    """Cancel a job that waits or runs."""
    _found(state, id)
    if not state.cancel(id):
        raise Problem(409, "the job is finished")
    return _answer(_found(state, id), state)


@router.get("/v1/jobs/{id}/log", response_class=PlainTextResponse)
def job_log(id: str, state: State) -> str:
    """What the job printed: its last part."""
    _found(state, id)
    folder = state.of_job(id)
    try:
        text = (folder / LOG).read_bytes()[-_MOST_LOG:].decode(errors="replace")
    except FileNotFoundError:  # it expires at this moment
        return ""
    return text.replace(str(folder), "").replace(str(state.path), "")


_RESULTS = {
    "result": (SUMMARY, "application/json"),
    "report.html": (f"{FILES}/{REPORT_FILE}", "text/html"),
    "files.zip": (ARCHIVE, "application/zip"),
}


@router.get("/v1/jobs/{id}/{part}", response_class=FileResponse)
def result(id: str, part: Literal["result", "report.html", "files.zip"], state: State) -> Response:
    """The result as ``--json`` prints it, the page that explains it, or all files."""
    record = _found(state, id)
    if record.state != "succeeded":
        why = f" ({record.error})" if record.error else ""
        raise Problem(409, f"the job has no result: it is {record.state}{why}")
    name, media_type = _RESULTS[part]
    path = state.of_job(id) / RESULT / name
    if not path.exists():
        raise Problem(404, "no such file: it was not asked for, or has been removed")
    policy = {"Content-Security-Policy": REPORT_POLICY} if part == "report.html" else {}
    return FileResponse(path, media_type=media_type, headers=policy)


@router.get("/", include_in_schema=False)
def jobs_page(state: State, before: Before = None) -> HTMLResponse:
    """The page for people: jobs, verdicts, reports; all text in it is escaped."""
    template = page_template("calibgraph.service")
    return HTMLResponse(template.render(list=list_jobs(state, before=before)))


@router.get("/healthz")
def healthz(state: State) -> dict[str, str]:
    """Whether jobs can be taken in: the database, the disk."""
    state.require_room(0)
    state.jobs.counts()
    return {"status": "ok"}


async def _tracker(
    name: TrackerName, request: Request, state: State, config: str = "{}"
) -> Response:
    """PUT a rig file to begin, POST frames (JSON lines), GET the last estimate, DELETE it."""
    text = await state.trackers.ask(request.method, name, await request.body(), config)
    return Response(text, media_type="application/json")


for _method in ("PUT", "POST", "GET", "DELETE"):
    router.add_api_route("/v1/trackers/{name}", _tracker, methods=[_method])
