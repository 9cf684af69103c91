"""The application: its routes and what they share."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from calibgraph.service import routes, trackers
from calibgraph.service.problems import add_problem_handlers
from calibgraph.service.request_guard import RequestGuard
from calibgraph.service.settings import Settings
from calibgraph.service.state import Service

STATIC_FOLDER = Path(__file__).parent / "static"


def create_app(settings: Settings) -> FastAPI:
    """The application of a server; its parts are ``app.state.service``, see :class:`Service`."""
    app = FastAPI(
        title="calibgraph",
        description="Joint extrinsic calibration of cameras and a LiDAR.",
        redoc_url=None,
        lifespan=_lifespan,
    )
    app.state.service = service = Service(settings)
    app.add_middleware(
        RequestGuard, settings=settings, tokens=service.tokens, answers=service.answers
    )
    files = StaticFiles(directory=STATIC_FOLDER, packages=[("calibgraph.report", "static")])
    app.mount("/static", files, name="static")
    for router in (routes.router, trackers.router):
        app.include_router(router)
    add_problem_handlers(app)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    service.runner.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.stop)
