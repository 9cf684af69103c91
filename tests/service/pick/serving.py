"""A server of a session in a thread, on a free port."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from calibgraph.service.pick.router import loopback_socket, pick_server
from calibgraph.service.pick.workspace import Workspace

START_S, STOP_S = 20.0, 20.0


@contextmanager
def serving(workspace: Workspace) -> Iterator[str]:
    """Serve while the block runs; gives the address."""
    server, listening = pick_server(workspace), loopback_socket(0)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, daemon=True)
    thread.start()
    deadline = time.monotonic() + START_S
    while not server.started and time.monotonic() < deadline:
        time.sleep(0.01)
    assert server.started
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(STOP_S)
        assert not thread.is_alive()
        listening.close()
