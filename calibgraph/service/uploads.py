"""A request for a job: its form is read and checked, put on disk, and only then acknowledged."""

import secrets
import shutil
from pathlib import Path

from fastapi import Request
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData, UploadFile

from calibgraph.files import describe
from calibgraph.service.jobs import JobRecord
from calibgraph.service.problems import Problem
from calibgraph.service.requests import (
    INPUT,
    LOG,
    MAX_RECORDINGS,
    PARTS,
    RECORDING,
    SETTINGS_OF,
    TEXTS,
    Job,
    JobKind,
    recording_name,
)
from calibgraph.service.state import Service

MOST_TEXT_BYTES = 10**6


async def receive_job(request: Request, kind: JobKind, state: Service) -> JobRecord:
    """Read the form of a job, and add the job."""
    if not request.headers.get("content-type", "").startswith("multipart/form-data"):
        raise Problem(415, "send a form: multipart/form-data")
    try:
        form = await request.form(
            max_files=MAX_RECORDINGS + 2, max_fields=MAX_RECORDINGS + 5,
            max_part_size=MOST_TEXT_BYTES,
        )  # fmt: skip
    except LookupError as error:
        raise Problem(400, f"the form cannot be read ({error})") from error
    try:
        return await run_in_threadpool(_add, form, kind, state)
    finally:
        await form.close()


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
