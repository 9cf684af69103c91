"""The application: its routers, and what they share."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from calibgraph.service import (
    routes_jobs,
    routes_pages,
    routes_results,
    routes_service,
    routes_trackers,
)
from calibgraph.service.access import Gate, load_tokens
from calibgraph.service.metrics import Metrics
from calibgraph.service.problems import ProblemDetails, add_problem_handlers, add_schemas
from calibgraph.service.request_guard import LOCAL_NAMES, RequestGuard
from calibgraph.service.requests import REQUESTS, SETTINGS_OF
from calibgraph.service.settings import Settings
from calibgraph.service.state import Service

STATIC_FOLDER = Path(__file__).parent / "static"


def create_app(settings: Settings) -> FastAPI:
    """The application of a server.

    Further routers can be included. Their routes take :data:`calibgraph.service.access.Reader`,
    ``Submitter`` or ``Admin`` as a parameter to know who calls, and raise
    :class:`calibgraph.service.problems.Problem` or a ``CalibrationError`` to refuse. In
    ``app.state``: ``settings``, ``gate``, ``metrics``, ``service``. Files of ``static/`` are at
    ``/static``.

    Raises:
        CalibrationError: if the token file, the data folder, the database or a root cannot be
            used.
    """
    app = FastAPI(
        title="calibgraph",
        description="Joint extrinsic calibration of cameras and a LiDAR.",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        lifespan=_lifespan,
    )
    app.state.gate = Gate(None if settings.tokens is None else load_tokens(settings.tokens))
    app.state.settings = settings = _with_shares(settings, len(app.state.gate.tenants))
    app.state.metrics = metrics = Metrics()
    app.state.service = Service(settings, metrics)
    app.add_middleware(RequestGuard, hosts=_hosts(settings), observe=metrics.observe_request)
    app.mount(
        "/static",
        StaticFiles(directory=STATIC_FOLDER, packages=[("calibgraph.report", "static")]),
        name="static",
    )
    for router in (routes_jobs, routes_results, routes_trackers, routes_service, routes_pages):
        app.include_router(router.router)
    add_problem_handlers(app)
    bodies = (*REQUESTS.values(), *SETTINGS_OF.values(), routes_trackers.TrackerBody)
    add_schemas(app, (*bodies, ProblemDetails))
    return app


def _with_shares(settings: Settings, tenants: int) -> Settings:
    """The settings, by which no tenant has all the processes for jobs."""
    if settings.jobs_per_tenant is not None or tenants <= 1:
        return settings
    return settings.model_copy(update={"jobs_per_tenant": max(1, settings.jobs_at_once - 1)})


def _hosts(settings: Settings) -> tuple[str, ...]:
    """The names by which the server may be called; any if empty."""
    if settings.hosts:
        return tuple(name.lower() for name in settings.hosts)
    return LOCAL_NAMES if settings.tokens is None else ()


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    service.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.stop)
