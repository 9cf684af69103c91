"""Run a server until it is told to stop."""

import ipaddress
import resource
import socket
import ssl
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI

from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import require_file
from calibgraph.service.connections import LimitedConnection
from calibgraph.service.state import Service

_CLOSE_S = 5
"""Connections that are open when the server stops are closed after this."""
_IDLE_S = 75
"""Connections are kept for so long: a client that uses one as it is closed gets no answer."""
_BACKLOG = 4096


@dataclass(frozen=True)
class Address:
    """Where a server listens; without a certificate by plain HTTP."""

    host: str = "127.0.0.1"
    port: int = 8080
    certificate: Path | None = None
    key: Path | None = None


def require_safe(address: Address, *, has_tokens: bool) -> None:
    """Check that a server without tokens is for this machine alone."""
    if not has_tokens and not _is_loopback(address.host):
        raise CalibrationError(
            f"--host {address.host}: others could call; give --tokens FILE (see calibgraph token), "
            "or listen on 127.0.0.1"
        )


def require_certificate(address: Address) -> None:
    """Check that the files for TLS are some.

    Raises:
        FileError: if one is missing, or both are no certificate and its key.
    """
    for path in filter(None, (address.certificate, address.key)):
        require_file(path)
    if address.certificate is None:
        return
    try:
        ssl.create_default_context(ssl.Purpose.CLIENT_AUTH).load_cert_chain(
            address.certificate, address.key
        )
    except (ssl.SSLError, OSError) as error:
        why = f"is no PEM certificate that belongs to the key {address.key or 'in it'} ({error})"
        raise FileError(address.certificate, why) from error


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def serve(app: FastAPI, address: Address, announce: Callable[[str], None] | None = None) -> None:
    """Serve an application until SIGTERM or Ctrl-C; announce the URL once it listens."""
    service: Service = app.state.service
    require_safe(address, has_tokens=service.settings.tokens is not None)
    _allow_many_connections()
    server = Server(app, address, announce)
    try:
        server.run()
    except SystemExit as error:  # of uvicorn, after a line in its log
        if error.code:
            where = f"{address.host}:{address.port}"
            raise CalibrationError(f"{where}: cannot be listened on; see the line above") from error
    finally:
        if not service.is_stopping:  # it did not come to its start
            service.stop()


def _allow_many_connections() -> None:
    """Let this process have as many open files as it may: a connection is one."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


class Server(uvicorn.Server):
    """A server of uvicorn with limits on connections.

    Requests that wait for a job end as soon as a signal comes: uvicorn would wait for them.
    """

    def __init__(
        self, app: FastAPI, address: Address, announce: Callable[[str], None] | None = None
    ) -> None:
        config = uvicorn.Config(
            app,
            host=address.host,
            port=address.port,
            ssl_certfile=address.certificate,
            ssl_keyfile=address.key,
            http=LimitedConnection,
            ws="none",
            server_header=False,
            access_log=False,
            log_level="info",
            timeout_graceful_shutdown=_CLOSE_S,
            timeout_keep_alive=_IDLE_S,
            backlog=_BACKLOG,
        )
        super().__init__(config)
        self._service: Service = app.state.service
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen."""
        await super().startup(sockets=sockets)
        if self._announce is not None and self.started:
            host, port = self.servers[0].sockets[0].getsockname()[:2]
            reachable = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
            shown = f"[{reachable}]" if ":" in reachable else reachable
            scheme = "http" if self.config.ssl_certfile is None else "https"
            self._announce(f"{scheme}://{shown}:{port}")

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to stop."""
        self._service.is_stopping = True
        super().handle_exit(sig, frame)
