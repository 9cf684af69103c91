"""A server on a port of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from calibgraph.service.app import create_app
from calibgraph.service.serve import Address, Server
from calibgraph.service.settings import Settings


@contextmanager
def on_a_port(settings: Settings) -> Iterator[tuple[str, int, Any]]:
    """A server on loopback: its host, its port, its app."""
    app = create_app(settings)
    server = Server(app, Address(port=0))
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield "127.0.0.1", server.servers[0].sockets[0].getsockname()[1], app
    server.should_exit = True
    thread.join()
