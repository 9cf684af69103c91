"""The application of `calibgraph pick`: one session, for the person at this machine."""

import socket

import uvicorn
from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles

from calibgraph.errors import CalibrationError
from calibgraph.service.access import Gate
from calibgraph.service.app import STATIC_FOLDER
from calibgraph.service.connections import LimitedConnection
from calibgraph.service.metrics import Metrics
from calibgraph.service.pick.router import pick_router
from calibgraph.service.pick.workspace import Workspace
from calibgraph.service.problems import add_problem_handlers
from calibgraph.service.request_guard import LOCAL_NAMES, RequestGuard


def create_pick_app(workspace: Workspace) -> FastAPI:
    """The application of a session: its routes, without jobs and trackers."""
    app = FastAPI(title="calibgraph pick", docs_url=None, redoc_url=None)
    app.state.gate = Gate(None)
    app.add_middleware(RequestGuard, hosts=LOCAL_NAMES, observe=Metrics().observe_request)
    app.mount("/static", StaticFiles(directory=STATIC_FOLDER), name="static")
    add_problem_handlers(app)
    app.include_router(pick_router(workspace))
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
