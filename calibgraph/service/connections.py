"""Connections with limits: uvicorn's own have none on headers, on time, or on what is left unread.

The parser is httptools. Its callbacks show how far a request is, and one timer per
connection runs until the next step.
"""

import asyncio
from collections.abc import Callable
from typing import Any

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from calibgraph.service.problems import problem_response

MAX_HEADER_BYTES = 16 * 1024
"""Of the request line and the headers together; and of all else between two pieces of a body."""
HEADER_S = 10.0
"""From the connection, or the first byte of a request, to the end of its headers."""
BODY_S = 20.0
LEAST_BODY_BYTES = 10_000
"""The least part of a body in each BODY_S, unless the server itself does not read."""
UNREAD_S = 10.0
"""For the rest of a body that was answered before its end: who still sends can read the answer."""
REFUSED_S, REFUSED_BYTES = 1.0, 2**18
"""So much more is taken, unread, after a refusal: to close at once would take back the answer."""
WRITE_S = 60.0
"""A client takes some of the answer within this time."""


class LimitedConnection(HttpToolsProtocol):
    """A connection of uvicorn that ends if a request is too large or too slow."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._timer: asyncio.TimerHandle | None = None
        self._write_timer: asyncio.TimerHandle | None = None
        self._is_in_request = self._is_in_body = self._is_refused = False
        self._outside_body = 0  # bytes since the last step of the request
        self._body_bytes = 0  # in this BODY_S

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for a request."""
        super().connection_made(transport)
        transport.set_write_buffer_limits(0)  # pause_writing shows all that is not taken
        self._begin_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing more."""
        self._stop_waiting()
        self.resume_writing()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse some bytes, in pieces that no limit is passed by much."""
        self._begin_request()
        for start in range(0, len(data), MAX_HEADER_BYTES):
            if self._is_refused:
                self._drop(len(data) - start)
            if self._is_refused or self.transport.is_closing():
                return
            piece = data[start : start + MAX_HEADER_BYTES]
            self._outside_body += len(piece)
            super().data_received(piece)
            if self._outside_body >= MAX_HEADER_BYTES:
                self._refuse(431, f"request line and headers have over {MAX_HEADER_BYTES} bytes")

    def on_message_begin(self) -> None:
        """Callback of the parser: a request begins."""
        super().on_message_begin()
        self._begin_request()

    def on_headers_complete(self) -> None:
        """Callback of the parser: the headers of a request are there."""
        super().on_headers_complete()
        self._outside_body = self._body_bytes = 0
        self._is_in_body = True
        self._after(BODY_S, self._check_body)

    def on_body(self, body: bytes) -> None:
        """Callback of the parser: a piece of a body."""
        super().on_body(body)
        self._outside_body = 0
        self._body_bytes += len(body)

    def on_message_complete(self) -> None:
        """Callback of the parser: a request is whole."""
        super().on_message_complete()
        self._is_in_request = self._is_in_body = False
        self._outside_body = 0
        self._stop_waiting()
        if self.cycle.response_complete:
            self._after(self.timeout_keep_alive, self.transport.close)

    def on_response_complete(self) -> None:
        """Callback of the answer: it is whole."""
        super().on_response_complete()
        if self._is_in_body:
            self._after(UNREAD_S, self.transport.close)

    def pause_writing(self) -> None:
        """Callback of the transport: the client does not take the answer at present."""
        super().pause_writing()
        self._write_timer = self.loop.call_later(WRITE_S, self.transport.abort)

    def resume_writing(self) -> None:
        """Callback of the transport: it does."""
        super().resume_writing()
        if self._write_timer is not None:
            self._write_timer.cancel()
            self._write_timer = None

    def _begin_request(self) -> None:
        if not self._is_in_request:
            self._is_in_request = True
            self._after(HEADER_S, self._end_headers)

    def _after(self, seconds: float, act: Callable[[], None]) -> None:
        """Act at a later time, and not at the one set before."""
        self._stop_waiting()
        self._timer = self.loop.call_later(seconds, act)

    def _stop_waiting(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _end_headers(self) -> None:
        if not self._outside_body:  # a browser opens connections before it needs them
            self.transport.close()
        self._refuse(408, f"the headers are not complete after {HEADER_S:g} s")

    def _check_body(self) -> None:
        """End a request whose body does not get on."""
        if self._body_bytes < LEAST_BODY_BYTES and not self.flow.read_paused:
            self._refuse(408, f"the body brings under {LEAST_BODY_BYTES} bytes in {BODY_S:g} s")
            return
        self._body_bytes = 0
        self._after(BODY_S, self._check_body)

    def _refuse(self, status: int, text: str) -> None:
        """End the connection, with an answer unless another is being sent."""
        if self.transport.is_closing():
            return
        if self._is_answering():
            self.transport.close()
            return
        answer = problem_response(status, text, {"Connection": "close"})
        headers = [b"%s: %s\r\n" % header for header in answer.raw_headers]
        lines = [STATUS_LINE[status], *headers, b"\r\n", bytes(answer.body)]
        self.transport.write(b"".join(lines))
        if self.transport.can_write_eof():
            self.transport.write_eof()
        self._is_refused, self._outside_body = True, 0
        self._after(REFUSED_S, self.transport.close)

    def _drop(self, count: int) -> None:
        """Leave bytes unread that come after a refusal."""
        self._outside_body += count
        if self._outside_body > REFUSED_BYTES:
            self.transport.close()

    def _is_answering(self) -> bool:
        cycle = self.cycle
        return cycle is not None and cycle.response_started and not cycle.response_complete
