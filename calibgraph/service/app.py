"""The application: its routes and what they share; and its server, until it is told to stop."""

import asyncio
import ipaddress
import logging
import signal
import socket
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import hypercorn.asyncio
from fastapi import FastAPI
from fastapi.staticfiles import StaticFiles
from starlette.concurrency import run_in_threadpool

from calibgraph.errors import CalibrationError
from calibgraph.service.problems import add_problem_handlers
from calibgraph.service.request_guard import RequestGuard
from calibgraph.service.requests import Settings
from calibgraph.service.routes import router
from calibgraph.service.state import Service

STATIC_FOLDER = Path(__file__).parent / "static"
HEADER_BYTES = 16 * 1024
"""Of the request line and headers, before which a connection ends."""
IDLE_S = 20.0
"""A connection ends after this without a request, or with headers that are not complete."""
_CLOSE_S, _BACKLOG = 5, 4096


def create_app(settings: Settings) -> FastAPI:
    """The application of a server; its parts are ``app.state.service``, see :class:`Service`."""
    app = FastAPI(
        title="calibgraph",
        description="Joint extrinsic calibration of cameras and a LiDAR.",
        docs_url=None,  # a page that needs a network
        redoc_url=None,
        lifespan=_lifespan,
    )
    app.state.service = service = Service(settings)
    app.add_middleware(RequestGuard, settings=settings, tokens=service.tokens)
    files = StaticFiles(directory=STATIC_FOLDER, packages=[("calibgraph.report", "static")])
    app.mount("/static", files, name="static")
    app.include_router(router)
    add_problem_handlers(app)
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    service.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.stop)


def require_safe(host: str, *, has_tokens: bool) -> None:
    """Check that a server without tokens is for this machine alone."""
    try:
        is_loopback = ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_loopback = host == "localhost"
    if not has_tokens and not is_loopback:
        raise CalibrationError(
            f"--host {host}: others could call; give --tokens FILE, or listen on 127.0.0.1; a "
            "token is added to the file by calibgraph serve --tokens FILE --new-token"
        )


def serve(app: FastAPI, host: str, port: int, announce: Callable[[str], None]) -> None:
    """Serve an application until SIGTERM or Ctrl-C; announce the URL once it listens."""
    service: Service = app.state.service
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    tempfile.tempdir = str(service.arriving)  # uploads arrive on the disk that has room
    try:
        listening = _listen(host, port)
        shown = f"[{host}]" if ":" in host else host
        announce(f"http://{shown}:{listening.getsockname()[1]}")
        config = hypercorn.Config()
        config.bind = [f"fd://{listening.detach()}"]
        config.h11_max_incomplete_size = HEADER_BYTES
        config.keep_alive_timeout = IDLE_S
        config.backlog, config.graceful_timeout = _BACKLOG, _CLOSE_S
        config.shutdown_timeout = service.settings.grace_s + _CLOSE_S
        config.include_server_header = False
        config.errorlog = logging.getLogger("calibgraph.service")
        asyncio.run(_serve(app, config))
    finally:
        if not service.is_stopping:  # it did not come to its start
            service.stop()


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        raise CalibrationError(
            f"{host}:{port}: cannot be listened on ({error.strerror})"
        ) from error


async def _serve(app: FastAPI, config: hypercorn.Config) -> None:
    stopping = asyncio.Event()

    def stop() -> None:
        app.state.service.begin_stop()  # who waits for a job is answered
        stopping.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop)
    framework: Any = app
    await hypercorn.asyncio.serve(framework, config, shutdown_trigger=stopping.wait)
