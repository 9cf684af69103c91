"""Routes of the service itself: is it alive, can it work, its numbers, its API in words."""

from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.responses import PlainTextResponse
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError

from calibgraph.service.access import Admin, Credentials, require
from calibgraph.service.metrics import CONTENT_TYPE
from calibgraph.service.problems import Problem, documented
from calibgraph.service.state import Service, State

router = APIRouter()


class Status(BaseModel):
    """That the server is well."""

    status: str = "ok"


@router.get("/healthz", responses=documented())
async def healthz() -> Status:
    """Whether the process answers."""
    return Status()


@router.get("/readyz", responses=documented(507))
def readyz(state: State) -> Status:
    """Whether jobs can be taken in: the database, the disk, the threads that run them."""
    state.require_room()
    try:
        state.jobs.count("queued")
    except SQLAlchemyError as error:
        raise Problem(503, "the database cannot be read") from error
    if not state.runner.is_alive():
        raise Problem(503, "no jobs are run; restart the server")
    return Status()


@router.get(
    "/metrics",
    response_class=PlainTextResponse,
    responses={**documented(), 200: {"content": {"text/plain": {}}}},
)
def metrics(state: State, caller: Admin) -> Response:
    """Numbers for Prometheus."""
    state.metrics.queued.set(state.jobs.count("queued"))
    state.metrics.running.set(state.jobs.count("running"))
    return Response(state.metrics.text(), media_type=CONTENT_TYPE)


@router.get("/openapi.json", include_in_schema=False)
async def openapi(request: Request, state: State, credentials: Credentials) -> dict[str, Any]:
    """The description of the API, for whom the operator lets read it."""
    require_docs(state)
    if state.settings.api_docs == "token":
        await require("read")(request, credentials)
    description: dict[str, Any] = request.app.openapi()
    return description


def require_docs(state: Service) -> None:
    """Check that this server describes its API."""
    if state.settings.api_docs == "off":
        raise Problem(404, "this server does not describe its API; see calibgraph serve --api-docs")
