"""Routes of a session of picking, under ``/v1/pick``, its page, ``/pick``, and their server."""

import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import cv2
import uvicorn
from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi.responses import FileResponse, RedirectResponse
from fastapi.staticfiles import StaticFiles
from pydantic import BaseModel, ConfigDict, Field

from calibgraph.errors import CalibrationError
from calibgraph.service.access import Gate, Reader, Submitter
from calibgraph.service.app import STATIC_FOLDER
from calibgraph.service.connections import LimitedConnection
from calibgraph.service.metrics import Metrics
from calibgraph.service.pick.answers import (
    CornerAnswer,
    EstimateAnswer,
    SessionAnswer,
    WrittenAnswer,
    estimate_answer,
    session_answer,
)
from calibgraph.service.pick.reference import reference_rig
from calibgraph.service.pick.session import MAX_PAIRS, PICK_SIGMA_PX, Coordinate, Pair, Session
from calibgraph.service.pick.workspace import Change, StaleError, Workspace
from calibgraph.service.problems import Problem, add_problem_handlers, documented
from calibgraph.service.request_guard import LOCAL_NAMES, RequestGuard

STATIC_PAGE = Path(__file__).parents[1] / "static" / "pick" / "index.html"

Pixel = tuple[Coordinate, Coordinate]
Place = Annotated[int, Field(ge=0, lt=MAX_PAIRS)]
Pose = Literal["guess", "estimate"]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    revision: Annotated[int, Field(ge=0)]


class Revision(_Body):
    """The revision of the session that a change is meant for."""


class NewPair(_Body):
    """A pair to add; its point is a row of the frame's cloud."""

    frame: int
    camera: str
    pixel_px: Pixel
    point_index: Annotated[int, Field(ge=0)]
    sigma_px: Annotated[float, Field(ge=0.05, le=100)] = PICK_SIGMA_PX


class PairChange(_Body):
    """What to change of a pair."""

    pixel_px: Pixel | None = None
    used: bool | None = None


router = APIRouter(responses=documented(404, 409, 422))


async def _workspace(request: Request) -> Workspace:
    workspace: Workspace = request.app.state.workspace
    return workspace


Work = Annotated[Workspace, Depends(_workspace)]
"""A parameter of routes: the session with its dataset."""


@router.get("/", include_in_schema=False)
def home() -> Response:
    """To the page."""
    return RedirectResponse("/pick")


@router.get("/pick", include_in_schema=False)
def page() -> Response:
    """The page."""
    return FileResponse(STATIC_PAGE, media_type="text/html")


@router.get("/v1/pick/session")
def session(caller: Reader, workspace: Work) -> SessionAnswer:
    """The frames, the cameras and the pairs."""
    return session_answer(workspace)


@router.get("/v1/pick/estimate")
def estimate(
    caller: Reader, workspace: Work, frame: int | None = None, camera: str | None = None
) -> EstimateAnswer:
    """What the pairs determine; with a frame and a camera, where to pick next."""
    revision, found = workspace.session.revision, workspace.estimate()
    given = frame is not None and camera is not None
    advice = workspace.advice(frame or 0, camera or "") if given else None
    return estimate_answer(revision, found, advice)


@router.get("/v1/pick/frames/{frame}/images/{camera}", response_class=Response)
def image(caller: Reader, workspace: Work, frame: int, camera: str) -> Response:
    """The image as recorded, PNG."""
    _, data = cv2.imencode(".png", workspace.image(frame, camera))
    return Response(data.tobytes(), media_type="image/png")


@router.get("/v1/pick/frames/{frame}/cloud", response_class=Response)
def cloud(caller: Reader, workspace: Work, frame: int) -> Response:
    """The cloud: x y z [m] and intensity of each point, float32, little-endian."""
    data = workspace.cloud(frame).astype("<f4").tobytes()
    return Response(data, media_type="application/octet-stream")


@router.get("/v1/pick/frames/{frame}/visible/{camera}", response_class=Response)
def visible(
    caller: Reader, workspace: Work, frame: int, camera: str, *, pose: Pose = "guess"
) -> Response:
    """The points in view that nothing hides: count, rows, columns, lines, distances."""
    seen = workspace.visible(frame, camera, estimated=pose == "estimate")
    return Response(seen.to_bytes(), media_type="application/octet-stream")


@router.get("/v1/pick/frames/{frame}/corner/{camera}")
def corner(
    caller: Reader,
    workspace: Work,
    frame: int,
    camera: str,
    *,
    u: Annotated[float, Query(ge=-1e5, le=1e5)],
    v: Annotated[float, Query(ge=-1e5, le=1e5)],
) -> CornerAnswer:
    """The corner near a pixel."""
    found = workspace.corner(frame, camera, (u, v))
    pixel = None if found is None else (float(found[0]), float(found[1]))
    return CornerAnswer(pixel_px=pixel)


def _changed(workspace: Workspace, revision: int, change: Change) -> SessionAnswer:
    try:
        workspace.change(revision, change)
    except StaleError:
        raise Problem(409, "the session was changed in another window; reload the page") from None
    return session_answer(workspace)


@router.post("/v1/pick/pairs", status_code=201)
def add(caller: Submitter, workspace: Work, body: NewPair) -> SessionAnswer:
    """Add a pair."""
    pair = _pair(workspace, body)
    return _changed(
        workspace, body.revision, lambda session: _with(session, [*session.pairs, pair])
    )


@router.patch("/v1/pick/pairs/{place}")
def alter(caller: Submitter, workspace: Work, place: Place, body: PairChange) -> SessionAnswer:
    """Move a pair's pixel, or leave it out of the estimate."""
    update = body.model_dump(exclude={"revision"}, exclude_none=True)

    def change(session: Session) -> Session:
        pairs = _pairs_with(session, place)
        pairs[place] = pairs[place].model_copy(update=update)
        return session.with_pairs(pairs)

    return _changed(workspace, body.revision, change)


@router.post("/v1/pick/pairs/{place}/remove")
def remove(caller: Submitter, workspace: Work, place: Place, body: Revision) -> SessionAnswer:
    """Remove a pair."""

    def change(session: Session) -> Session:
        pairs = _pairs_with(session, place)
        return session.with_pairs([*pairs[:place], *pairs[place + 1 :]])

    return _changed(workspace, body.revision, change)


@router.post("/v1/pick/undo")
def undo(caller: Submitter, workspace: Work, body: Revision) -> SessionAnswer:
    """Take the last change back."""
    return _changed(workspace, body.revision, Session.undone)


@router.post("/v1/pick/redo")
def redo(caller: Submitter, workspace: Work, body: Revision) -> SessionAnswer:
    """Make an undone change again."""
    return _changed(workspace, body.revision, Session.redone)


@router.post("/v1/pick/reference")
def write(caller: Submitter, workspace: Work) -> WrittenAnswer:
    """Write reference.yaml, and the pairs as a table of correspondences."""
    paths = workspace.write()
    cameras = list(reference_rig(workspace.estimate()).cameras)
    return WrittenAnswer(files=[path.name for path in paths], cameras=cameras)


def _pair(workspace: Workspace, body: NewPair) -> Pair:
    """The pair that is to be added."""
    workspace.camera(body.camera, estimated=False)
    cloud = workspace.cloud(body.frame)
    if body.point_index >= len(cloud):
        raise Problem(422, f"point_index {body.point_index}: the cloud has {len(cloud)} points")
    x, y, z = cloud[body.point_index, :3].astype(float).tolist()
    return Pair(**body.model_dump(exclude={"revision"}), point_lidar_m=(x, y, z))


def _with(session: Session, pairs: Sequence[Pair]) -> Session:
    if len(pairs) > MAX_PAIRS:
        raise Problem(409, f"a session has at most {MAX_PAIRS} pairs")
    return session.with_pairs(pairs)


def _pairs_with(session: Session, place: int) -> list[Pair]:
    """The pairs of a session that has this place."""
    if place >= len(session.pairs):
        raise Problem(404, f"the session has {len(session.pairs)} pairs")
    return list(session.pairs)


def create_pick_app(workspace: Workspace) -> FastAPI:
    """The application of a session: its routes, without jobs and trackers."""
    app = FastAPI(title="calibgraph pick", docs_url=None, redoc_url=None)
    app.state.gate = Gate(None)
    app.add_middleware(RequestGuard, hosts=LOCAL_NAMES, observe=Metrics().observe_request)
    app.mount("/static", StaticFiles(directory=STATIC_FOLDER), name="static")
    add_problem_handlers(app)
    app.state.workspace = workspace
    app.include_router(router)
    return app


def loopback_socket(port: int) -> socket.socket:
    """A socket that listens on this machine alone."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind(("127.0.0.1", port))
    except OSError as error:
        listening.close()
        raise CalibrationError(
            f"port {port} cannot be used ({error.strerror}); give another with --port"
        ) from error
    return listening


def pick_server(workspace: Workspace) -> uvicorn.Server:
    """A server of a session; ``run(sockets=[...])`` serves until it is interrupted."""
    config = uvicorn.Config(
        create_pick_app(workspace),
        http=LimitedConnection,
        ws="none",
        log_level="warning",
        server_header=False,
        access_log=False,
    )
    return uvicorn.Server(config)
