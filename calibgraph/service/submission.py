"""A request for a job: read, checked, put on disk, and only then acknowledged."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fastapi import Request
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool

from calibgraph.files import describe
from calibgraph.model.config import Config
from calibgraph.service.access import Caller
from calibgraph.service.folders import sync_tree
from calibgraph.service.jobs import JobRecord, OtherRequestError, new_id
from calibgraph.service.places import require_inside
from calibgraph.service.problems import Problem
from calibgraph.service.requests import (
    ABOUT,
    ALLOWED,
    INPUT,
    LOG,
    MAX_RECORDINGS,
    RECORDING,
    REQUESTS,
    REQUIRED,
    SETTINGS_OF,
    Job,
    JobKind,
    job_of,
    recording_name,
)
from calibgraph.service.settings import MAX_JSON_BYTES
from calibgraph.service.state import Service
from calibgraph.service.uploads import FormReader, Upload

SETTINGS = "settings"
FORM_SETTINGS: Mapping[JobKind, tuple[str, ...]] = {
    kind: tuple(name for name in model.model_fields if name != "config")
    for kind, model in SETTINGS_OF.items()
}
"""Settings that a form may give as a field of its own."""
_MOST_KEY = 255
_RETRY_AFTER_S = 5


async def submit(
    service: Service, request: Request, caller: Caller, kind: JobKind, *, key: str | None
) -> JobRecord:
    """Take in a job, of JSON with URIs or a form with files; it is durable when this returns.

    Returns:
        The job; that of the first request with the key if there was one.

    Raises:
        Problem: if the request is malformed or too large, or there is no room.
    """
    _require_key(key)
    service.require_room()
    await run_in_threadpool(_require_place_unless_known, service, caller.tenant, key)
    id = new_id()
    arriving = service.folder.arriving / id
    (arriving / INPUT).mkdir(parents=True, mode=0o700)
    try:
        job, digest = await _read(service, request, caller, kind, folder=arriving / INPUT)
        return await run_in_threadpool(
            _keep, service, arriving, caller.tenant, job, digest=digest, key=key
        )
    except OtherRequestError:
        raise Problem(422, "this Idempotency-Key was given with another request") from None
    finally:
        if arriving.exists():  # it was not kept
            await run_in_threadpool(shutil.rmtree, arriving, ignore_errors=True)


def _require_key(key: str | None) -> None:
    if key is not None and not (0 < len(key) <= _MOST_KEY and key.isprintable()):
        raise Problem(422, f"Idempotency-Key: expected 1 to {_MOST_KEY} printable characters")


def _require_place_unless_known(service: Service, tenant: str, key: str | None) -> None:
    if service.jobs.known(tenant, key) is None:
        _require_place_in_queue(service, tenant)


def _require_place_in_queue(service: Service, tenant: str) -> None:
    waiting = service.jobs.count("queued", tenant)
    if waiting >= service.settings.most_queued:
        raise Problem(
            429,
            f"{waiting} of your jobs wait already; try again",
            {"Retry-After": str(_RETRY_AFTER_S)},
        )


async def _read(
    service: Service, request: Request, caller: Caller, kind: JobKind, *, folder: Path
) -> tuple[Job, str]:
    """The job that a request asks for, its uploads in a folder; and the digest of all."""
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media == "multipart/form-data":
        allowed = {name: 1 for name in ALLOWED[kind]} | (
            {RECORDING: MAX_RECORDINGS} if RECORDING in ALLOWED[kind] else {}
        )
        with service.disk.hold(request, caller.tenant, service.settings.upload_bytes) as arrive:
            upload = await FormReader(folder, allowed).read(request, arrive)
        job, digest = _job_of_form(upload, kind), f"{kind} {upload.digest}"
    elif media == "application/json":
        body = await service.memory.read(request, caller.tenant, MAX_JSON_BYTES)
        job = job_of(_checked(REQUESTS[kind], parse_json(body)), kind)
        digest = f"{kind} {job.model_dump_json()}"
    else:
        raise Problem(415, "send application/json with URIs, or multipart/form-data with files")
    for uri in job.uris.values():
        await run_in_threadpool(require_inside, uri, service.roots)
    return job, hashlib.sha256(digest.encode()).hexdigest()


def _hint(kind: JobKind, name: str) -> str:
    """Where a setting of the solve goes, if a field of a form is named as one."""
    if "config" not in SETTINGS_OF[kind].model_fields or name not in Config.model_fields:
        return ""
    return f"; give it as {SETTINGS}={json.dumps({'config': {name: '...'}})}"


def _job_of_form(upload: Upload, kind: JobKind) -> Job:
    """The job of a form: fields are URIs or the settings, files are in the folder already."""
    uris, about = dict[str, str](), dict[str, str]()
    settings: dict[str, Any] = {}
    files = {*upload.files}
    for name, text in upload.texts:
        if not text.strip():
            continue  # left empty
        if name == SETTINGS:
            settings |= _mapping(parse_json(text.encode()))
        elif name in ABOUT:
            about[name] = text
        elif name in FORM_SETTINGS[kind]:
            settings[name] = text
        elif name in ALLOWED[kind]:
            uris[_free_name(name, files | uris.keys())] = text
        else:
            known = ", ".join((*ALLOWED[kind], SETTINGS, *ABOUT, *FORM_SETTINGS[kind]))
            raise Problem(422, f"unknown field {name[:60]!r}; known are {known}{_hint(kind, name)}")
    given = files | uris.keys()
    for name in REQUIRED[kind]:
        if name not in given:
            raise Problem(422, f"{name!r} is missing; add it as a file, or a field with its URI")
    content = {
        "kind": kind,
        "uris": uris,
        "recordings": sum(name.startswith(RECORDING) for name in given),
        "settings": _checked(SETTINGS_OF[kind], settings).model_dump(mode="json"),
        **about,
    }
    job: Job = _checked(Job, content)
    return job


def _free_name(name: str, taken: set[str]) -> str:
    """The name of a further input: several recordings are numbered."""
    if name != RECORDING:
        if name in taken:
            raise Problem(422, f"{name!r} is given twice")
        return name
    count = sum(other.startswith(RECORDING) for other in taken)
    if count >= MAX_RECORDINGS:
        raise Problem(422, f"over {MAX_RECORDINGS} recordings")
    return recording_name(count)


def _keep(
    service: Service, arriving: Path, tenant: str, job: Job, *, digest: str, key: str | None
) -> JobRecord:
    """Put the input in its place, then the job into the table."""
    (arriving / LOG).touch()
    known = service.jobs.known(tenant, key, digest)
    if known is not None:
        return known
    _require_place_in_queue(service, tenant)
    sync_tree(arriving)
    folder = service.folder.of_job(arriving.name)
    service.folder.keep(arriving, folder)
    try:
        record = service.jobs.add(folder.name, tenant, job, digest, key=key)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    if record.id != folder.name:  # another request with the key was faster
        shutil.rmtree(folder, ignore_errors=True)
    else:
        service.runner.wake()
    return record


def parse_json(body: bytes) -> Any:
    """The content of a JSON body."""
    try:
        return json.loads(body)
    except RecursionError:
        raise Problem(400, "the JSON is nested too deeply") from None
    except ValueError as error:
        raise Problem(400, f"the body is not JSON ({error})") from error


def _mapping(content: object) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise Problem(422, "expected a JSON object")
    return content


def _checked(model: Any, content: object) -> Any:
    try:
        return model.model_validate(_mapping(content))
    except ValidationError as error:
        raise Problem(422, describe(error)) from error
