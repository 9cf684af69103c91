"""Routes of trackers: one per rig, frames in, estimates out."""

import json
import shutil
from typing import Annotated, Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict
from starlette.concurrency import run_in_threadpool

from calibgraph.files import checked_model
from calibgraph.model.config import config_from
from calibgraph.service.access import Caller, Name, Reader, Submitter
from calibgraph.service.database import TrackerRecord
from calibgraph.service.jobs import new_id
from calibgraph.service.problems import Problem, documented, reference
from calibgraph.service.routes_jobs import utc
from calibgraph.service.settings import MAX_JSON_BYTES
from calibgraph.service.state import Service, State
from calibgraph.service.submission import parse_json
from calibgraph.service.tracker_request import Action, TrackerRequest
from calibgraph.yaml_text import yaml_text

router = APIRouter(prefix="/v1/trackers")

TrackerId = Annotated[str, "id of a tracker"]
_LINES = ("application/x-ndjson", "application/jsonl", "application/json")
_FRAMES_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/x-ndjson": {"schema": {"type": "string", "format": "binary"}},
        },
    }
}


class TrackerBody(BaseModel):
    """A tracker that is asked for.

    Attributes:
        rig: the guess, as in a rig file.
        config: settings, as in a ``--config`` file.
        name: for people.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    rig: dict[str, Any]
    config: dict[str, Any] = {}
    name: Name = "tracker"


class TrackerAnswer(BaseModel):
    """A tracker.

    Attributes:
        name: that it was given.
        created: time (UTC), ISO 8601.
    """

    id: str
    name: str
    created: str


class FramesAnswer(BaseModel):
    """What became of frames.

    Attributes:
        updates: per frame that was taken in, and is on disk, what ``track`` prints.
        known: frames that were taken in before, or are older than the last.
        refused: what was left out, and why.
    """

    updates: list[dict[str, Any]]
    known: int
    refused: list[str]


class TrackerState(BaseModel):
    """The last estimate of a tracker.

    Attributes:
        frame: last frame that was taken in; null if none.
        verdict: of the estimate: PASS, WARN or FAIL.
        cannot_tell: whether it is WARN because the data determine too little.
        summary: the verdict in few words, as ``--json`` prints it: reasons, actions, others.
        cameras: per camera, as in a result.
        events: the last ones.
    """

    frame: int | None
    verdict: str
    cannot_tell: bool
    reasons: list[str]
    summary: dict[str, Any] = {}
    cameras: dict[str, Any]
    events: list[dict[str, Any]]


def tracker_answer(record: TrackerRecord) -> TrackerAnswer:
    """A tracker as an answer."""
    return TrackerAnswer(id=record.id, name=record.name, created=utc(record.created_s).isoformat())


def find_tracker(state: Service, caller: Caller, id: str) -> TrackerRecord:
    """The tracker of an id."""
    record = state.tracker_table.get(id, caller)
    if record is None:
        raise Problem(404, "no such tracker")
    return record


async def ask_tracker(state: Service, caller: Caller, id: str, action: Action) -> Any:
    """The answer of a tracker that the caller sees."""
    find_tracker(state, caller, id)
    request = TrackerRequest(action, str(state.folder.of_tracker(id)))
    return await state.trackers.answer(id, caller.tenant, request)


@router.post(
    "",
    status_code=201,
    response_model=TrackerAnswer,
    responses=documented(413, 415, 422, 429, 507),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": reference(TrackerBody)}},
        }
    },
)
async def create_tracker(request: Request, state: State, caller: Submitter) -> Response:
    """Begin to track a rig."""
    if not request.headers.get("content-type", "").startswith("application/json"):
        raise Problem(415, "send application/json")
    content = parse_json(await state.memory.read(request, caller.tenant, MAX_JSON_BYTES))
    if not isinstance(content, dict):
        raise Problem(422, "expected a JSON object")
    body = checked_model(TrackerBody, content, "tracker")
    config_from(body.config, "config")
    record = await _create(state, caller.tenant, body)
    headers = {"Location": f"/v1/trackers/{record.id}"}
    return JSONResponse(tracker_answer(record).model_dump(), 201, headers)


async def _create(state: Service, tenant: str, body: TrackerBody) -> TrackerRecord:
    state.require_room()
    id = new_id()
    folder = state.folder.of_tracker(id)
    with state.trackers.begin(tenant) as begun:
        held = state.tracker_table.count(tenant)
        if held + begun > state.settings.most_trackers:
            raise Problem(429, f"you have {held} trackers; remove one", {"Retry-After": "60"})
        folder.mkdir(mode=0o700)
        try:
            config = json.dumps(body.config)
            rig = (await run_in_threadpool(yaml_text, body.rig)).encode()
            request = TrackerRequest("create", str(folder), rig, config=config)
            await state.trackers.answer(id, tenant, request)
            return await run_in_threadpool(state.tracker_table.add, id, tenant, body.name)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise


@router.get("", responses=documented())
def list_trackers(state: State, caller: Reader) -> list[TrackerAnswer]:
    """The trackers of the tenant, the newest first."""
    return [tracker_answer(record) for record in state.tracker_table.list(caller)]


@router.post(
    "/{id}/frames",
    response_model=FramesAnswer,
    responses=documented(404, 413, 415, 422, 429, 507),
    openapi_extra=_FRAMES_BODY,
)
async def add_frames(id: TrackerId, request: Request, state: State, caller: Submitter) -> Response:
    """Take in frames, as JSON lines. What is answered is on disk."""
    find_tracker(state, caller, id)
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in _LINES:
        raise Problem(415, f"send {_LINES[0]}, a frame a line")
    body = await state.memory.read(request, caller.tenant, state.settings.frames_bytes)
    frames = TrackerRequest("frames", str(state.folder.of_tracker(id)), body)
    taken = await state.trackers.answer(id, caller.tenant, frames)
    state.metrics.frames.inc(taken.count)
    return Response(taken.body, media_type="application/json")


@router.get("/{id}/state", responses=documented(404, 422, 429))
async def tracker_state(id: TrackerId, state: State, caller: Reader) -> TrackerState:
    """The last estimate, with its error bars, verdicts and events."""
    return TrackerState(**await ask_tracker(state, caller, id, "state"))


@router.get(
    "/{id}/drift.png",
    response_class=Response,
    responses={**documented(404, 422, 429), 200: {"content": {"image/png": {}}}},
)
async def drift_plot(id: TrackerId, state: State, caller: Reader) -> Response:
    """The extrinsics over time, with their error bars and events."""
    return Response(await ask_tracker(state, caller, id, "plot"), media_type="image/png")


@router.delete("/{id}", status_code=204, responses=documented(404, 422, 429))
async def remove_tracker(id: TrackerId, state: State, caller: Submitter) -> Response:
    """Remove a tracker and its state."""
    find_tracker(state, caller, id)
    await run_in_threadpool(state.tracker_table.remove, id)
    asked = TrackerRequest("remove", str(state.folder.of_tracker(id)))
    await state.trackers.answer(id, caller.tenant, asked)
    return Response(status_code=204)
