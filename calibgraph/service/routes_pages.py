"""Pages for people: jobs with their verdicts, a job, trackers with their drift; sign in."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import parse_qs

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from starlette.concurrency import run_in_threadpool

from calibgraph.errors import CalibrationError
from calibgraph.io.formats.names import EXPORT_FORMATS
from calibgraph.model.result_files import REPORT_FILE
from calibgraph.report.kit import load_template
from calibgraph.service.access import COOKIE, Caller, Gate
from calibgraph.service.jobs import JobRecord
from calibgraph.service.problems import Problem
from calibgraph.service.requests import FILES, RESULT, SUMMARY, JobKind
from calibgraph.service.routes_jobs import find_job, utc
from calibgraph.service.routes_service import require_docs
from calibgraph.service.routes_trackers import ask_tracker, find_tracker
from calibgraph.service.state import Service, State
from calibgraph.service.submission import submit

router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)

_PER_PAGE = 50
_MOST_FORM_BYTES = 4096


async def _visitor(request: Request) -> Caller:
    """Who visits; the browser is sent to the page for tokens if it has none."""
    gate: Gate = request.app.state.gate
    caller = gate.caller(request.cookies.get(COOKIE))
    if caller is None:
        raise Problem(303, "sign in first", {"Location": "/sign-in"})
    return caller


Visitor = Annotated[Caller, Depends(_visitor)]


def _page(request: Request, template: str, status: int = 200, **content: object) -> Response:
    gate: Gate = request.app.state.gate
    can_sign_out = not gate.is_open and COOKIE in request.cookies
    has_docs = request.app.state.settings.api_docs != "off"
    fixed = {"can_sign_out": can_sign_out, "has_docs": has_docs}
    return HTMLResponse(render(template, **fixed, **content), status)


@router.get("/")
def jobs_page(
    request: Request,
    state: State,
    caller: Visitor,
    before: Annotated[int | None, Query(ge=0, le=2**62)] = None,
) -> Response:
    """The jobs, with their verdicts."""
    records = state.jobs.newest(caller, _PER_PAGE, before)
    following = records[-1].number if len(records) == _PER_PAGE else None
    is_later = before is not None
    return _page(request, "jobs.html.j2", jobs=records, next=following, is_later=is_later)


@router.get("/jobs/{id}")
def job_page(id: str, request: Request, state: State, caller: Visitor) -> Response:
    """A job: how far it is, or its verdict, its cameras and its files."""
    record = find_job(state, caller, id)
    folder = state.folder.of_job(id) / RESULT
    summary = read_summary(folder / SUMMARY) if record.state == "succeeded" else {}
    return _page(
        request,
        "job.html.j2",
        job=record,
        step=state.runner.step(id),
        actions=actions_of(summary),
        reasons=reasons_of(summary),
        cameras=summary.get("cameras", {}),
        page=_explanation(state, record),
        links=_links(record),
    )


def _explanation(state: Service, record: JobRecord) -> dict[str, str] | None:
    """The page that explains a job's result: its report, or the page of a check."""
    files = state.folder.of_job(record.id) / RESULT / FILES
    if not (files / REPORT_FILE).exists():
        return None
    name = "The page of this check, with pictures" if record.kind == "check" else "The report"
    return {"name": name, "path": f"/v1/jobs/{record.id}/report.html"}


def _links(record: JobRecord) -> list[dict[str, str]]:
    """What can be fetched of a job."""
    at = f"/v1/jobs/{record.id}"
    log = {"name": "Log", "path": f"{at}/log"}
    if record.state != "succeeded":
        return [log]
    result = {"name": "Result (JSON)", "path": f"{at}/result"}
    whole = {"name": "All files (zip)", "path": f"{at}/files.zip"}
    exports = [
        {"name": f"For {name}", "path": f"{at}/exports/{name}"}
        for name in EXPORT_FORMATS
        if record.verdict != "FAIL" and record.kind != "check"
    ]
    return [result, whole, log, *exports]


@router.get("/new/{kind}")
def new_page(kind: JobKind, request: Request, caller: Visitor) -> Response:
    """The form of a new job."""
    return _page(request, "new.html.j2", problem=None, kind=kind)


@router.post("/new/{kind}")
async def new_job(kind: JobKind, request: Request, state: State, caller: Visitor) -> Response:
    """Take in a job of the form; the form again, with the problem, if that cannot be done."""
    try:
        if not caller.may("submit"):
            raise Problem(403, f"this needs a token of scope submit, found {caller.scope}")
        record = await submit(state, request, caller, kind, key=None)
    except (Problem, CalibrationError) as error:
        status = error.status if isinstance(error, Problem) else 422
        return _page(request, "new.html.j2", status, problem=str(error), kind=kind)
    return RedirectResponse(f"/jobs/{record.id}", 303)


@router.get("/trackers")
def trackers_page(request: Request, state: State, caller: Visitor) -> Response:
    """The trackers."""
    return _page(request, "trackers.html.j2", trackers=state.tracker_table.list(caller))


@router.get("/trackers/{id}")
async def tracker_page(id: str, request: Request, state: State, caller: Visitor) -> Response:
    """A tracker: its verdict, its alarms, its extrinsics over time."""
    record = await run_in_threadpool(find_tracker, state, caller, id)
    found: dict[str, Any] = await ask_tracker(state, caller, id, "state")
    return _page(
        request,
        "tracker.html.j2",
        tracker=record,
        verdict_word=found["verdict"],
        frame=found["frame"],
        reasons=found["reasons"],
        events=[event["text"] for event in reversed(found["events"])],
        plot=f"/v1/trackers/{id}/drift.png",
        cameras=found["cameras"],
    )


@router.get("/docs")
async def api_page(request: Request, state: State) -> Response:
    """The API in words, for whom the operator lets read it."""
    require_docs(state)
    if state.settings.api_docs == "token":
        await _visitor(request)
    gate: Gate = request.app.state.gate
    return _page(
        request,
        "docs.html.j2",
        api=request.app.openapi(),
        as_text=partial(json.dumps, indent=1),
        url=str(request.base_url).rstrip("/"),
        is_open=gate.is_open,
    )


@router.get("/sign-in")
def sign_in_page(request: Request) -> Response:
    """Where a browser gives its token."""
    return _page(request, "sign_in.html.j2", problem=None)


@router.post("/sign-in")
async def sign_in(request: Request, state: State) -> Response:
    """Keep a token in the browser, where no script can read it."""
    body = await state.memory.read(request, "", _MOST_FORM_BYTES)
    fields = parse_qs(body.decode("utf-8", errors="replace"))
    secret = fields.get("token", [""])[0].strip()
    gate: Gate = request.app.state.gate
    if gate.caller(secret) is None:
        text = "No such token. Make one with calibgraph token, and give what it prints."
        return await run_in_threadpool(_page, request, "sign_in.html.j2", status=403, problem=text)
    answer = RedirectResponse("/", 303)
    answer.set_cookie(
        COOKIE, secret, httponly=True, samesite="strict", secure=request.url.scheme == "https"
    )
    return answer


@router.post("/sign-out")
async def sign_out() -> Response:
    """Forget the browser's token."""
    answer = RedirectResponse("/sign-in", 303)
    answer.delete_cookie(COOKIE, httponly=True, samesite="strict")
    return answer


_MINUTE_S = 60


def render(template: str, **content: object) -> str:
    """A page of ``pages/``; all text in it is escaped."""
    in_words = {"minute_of": minute_of, "duration_of": duration_of}
    page = load_template(template, "calibgraph.service", "pages")
    return page.render(**in_words, **content)


def minute_of(time_s: float) -> str:
    """A time since 1970 in words."""
    return f"{utc(time_s):%Y-%m-%d %H:%M} UTC"


def duration_of(seconds: float) -> str:
    """A duration in words."""
    if seconds < _MINUTE_S:
        return f"{max(seconds, 0):.1f} s"
    return f"{seconds // _MINUTE_S:.0f} min {seconds % _MINUTE_S:.0f} s"


def read_summary(path: Path) -> dict[str, Any]:
    """The summary of a result; an empty one if it has expired meanwhile."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    return content if isinstance(content, dict) else {}


def reasons_of(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Why a result is not PASS, or what a check found: status, cameras and text of each."""
    if "summary" in summary:
        found: list[Mapping[str, Any]] = summary["summary"]["reasons"]
        return found
    cameras: Mapping[str, Mapping[str, Any]] = summary.get("cameras", {})
    return [
        {"status": camera["status"], "cameras": [name], "text": camera["reason"]}
        for name, camera in cameras.items()
    ]


def actions_of(summary: Mapping[str, Any]) -> list[str]:
    """What to do about a result."""
    actions: list[str] = summary.get("summary", {}).get("actions", [])
    return actions
