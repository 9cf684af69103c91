"""The application: its routers, and what they share."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles

from calibgraph.service.access import Gate, load_tokens
from calibgraph.service.metrics import Metrics
from calibgraph.service.problems import add_problem_handlers
from calibgraph.service.settings import Settings
from calibgraph.service.shield import LOCAL_NAMES, Shield

STATIC_FOLDER = Path(__file__).parent / "static"


def create_app(settings: Settings) -> FastAPI:
    """The application of a server.

    Further routers can be included. Their routes take :data:`calibgraph.service.access.Reader`,
    ``Submitter`` or ``Admin`` as a parameter to know who calls, and raise
    :class:`calibgraph.service.problems.Problem` or a ``CalibrationError`` to refuse. In
    ``app.state``: ``settings``, ``gate``, ``metrics``. Files of ``static/`` are at ``/static``.

    Raises:
        FileError: if the token file or the data folder cannot be used.
    """
    app = FastAPI(
        title="calibgraph",
        description="Joint extrinsic calibration of cameras and a LiDAR.",
        docs_url=None,
        redoc_url=None,
        lifespan=_lifespan,
    )
    app.state.settings = settings
    app.state.gate = Gate(None if settings.tokens is None else load_tokens(settings.tokens))
    app.state.metrics = metrics = Metrics()
    app.add_middleware(Shield, hosts=_hosts(settings), observe=metrics.observe_request)
    app.mount("/static", StaticFiles(directory=STATIC_FOLDER), name="static")
    add_problem_handlers(app)
    return app


def _hosts(settings: Settings) -> tuple[str, ...]:
    """The names by which the server may be called; any if empty."""
    if settings.hosts:
        return tuple(name.lower() for name in settings.hosts)
    return LOCAL_NAMES if settings.tokens is None else ()


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    yield
