"""Connections that want to harm: headers without end, half requests, bodies that do not get on."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from calibgraph.service import connections
from calibgraph.service.settings import Settings
from tests.service.ports import on_a_port

SHORT_S = 0.5
MANY = 900
HALF_REQUESTS = (
    b"",
    b"GET /healthz HT",
    b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ",
    b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100\r\n\r\nab",
    b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\nGET /he",
    b"\r\n\r\n",
)

Place = tuple[str, int]


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    with on_a_port(Settings(data=tmp_path / "data", jobs_at_once=0, free_bytes=0)) as (
        host,
        port,
        _,
    ):
        yield host, port


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("HEADER_S", "BODY_S", "UNREAD_S", "WRITE_S"):
        monkeypatch.setattr(connections, name, SHORT_S)


def connect(place: Place) -> socket.socket:
    connection = socket.create_connection(place)
    connection.settimeout(30)
    return connection


def rest_of(connection: socket.socket) -> bytes:
    """All until the server ends the connection."""
    found = b""
    with suppress(ConnectionResetError):
        while some := connection.recv(65536):
            found += some
    return found


def flood(connection: socket.socket, most_bytes: int) -> int:
    """Send until the server ends the connection; how many bytes it took."""
    sent = 0
    with suppress(ConnectionResetError, BrokenPipeError):
        while sent < most_bytes:
            sent += connection.send(b"x" * 65536)
    return sent


def seconds_of_a_request(place: Place) -> float:
    start = time.perf_counter()
    with connect(place) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert rest_of(connection).startswith(b"HTTP/1.1 200")
    return time.perf_counter() - start


@pytest.mark.parametrize(
    "begin",
    [
        b"GET /",
        b"GET / HTTP/1.1\r\nX: ",
        b"GET / HTTP/1.1\r\nX",
        b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nX: ",
        b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n1;x=",
    ],
    ids=["path", "value", "name", "trailer", "extension of a chunk"],
)
def test_what_never_ends_is_cut_off(place: Place, begin: bytes) -> None:
    with connect(place) as connection:
        connection.sendall(begin)
        assert flood(connection, 50_000_000) < 20_000_000  # kernels hold some megabytes
    assert seconds_of_a_request(place) < 5


@pytest.mark.parametrize("count", [1, 200])
def test_headers_may_have_16_kb_together(place: Place, count: int) -> None:
    size = connections.MAX_HEADER_BYTES // count

    def status(each: int) -> bytes:
        lines = b"".join(b"X-%03d: %s\r\n" % (i, b"x" * each) for i in range(count))
        with connect(place) as connection:
            connection.sendall(
                b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n" + lines
            )
            with suppress(ConnectionResetError, BrokenPipeError):
                connection.sendall(b"\r\n")
            return rest_of(connection)[:12]

    assert status(size - 20 - 100 // count) == b"HTTP/1.1 200"
    assert status(size) == b"HTTP/1.1 431"


def test_many_half_requests_end_and_others_are_answered_meanwhile(
    place: Place, hasty: None
) -> None:
    usual = max(seconds_of_a_request(place) for _ in range(20))
    opened = []
    for i in range(MANY):
        opened.append(connect(place))
        opened[-1].sendall(HALF_REQUESTS[i % len(HALF_REQUESTS)])
    slowest = max(seconds_of_a_request(place) for _ in range(20))
    end = time.monotonic() + 30
    for connection in opened:
        connection.settimeout(max(0.1, end - time.monotonic()))
        rest_of(connection)  # a connection that stays open raises TimeoutError
        connection.close()
    assert slowest < 3 + 10 * usual  # the machine may be busy


def test_who_sends_a_byte_now_and_then_is_cut_off_too(place: Place, hasty: None) -> None:
    for begin in (HALF_REQUESTS[2], HALF_REQUESTS[3]):
        with connect(place) as connection, suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(begin)
            start = time.monotonic()
            while time.monotonic() - start < 20 * SHORT_S:
                connection.sendall(b"x")
                time.sleep(SHORT_S / 10)
            pytest.fail("the connection stayed open")


def test_a_body_that_was_refused_is_not_read_for_ever(place: Place, hasty: None) -> None:
    with connect(place) as connection:
        connection.sendall(
            b"POST /v1/nowhere HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000000000\r\n\r\n"
        )
        start = time.monotonic()
        with suppress(ConnectionResetError, BrokenPipeError):
            while time.monotonic() - start < 20 * SHORT_S:
                connection.sendall(b"x" * 65536)
            pytest.fail("the connection stayed open")


def test_a_slow_but_steady_body_arrives(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is up whenever there is enough of it: no clock of a busy machine takes part."""
    receive, checked = connections.LimitedConnection.on_body, []

    def receive_and_check(connection: connections.LimitedConnection, piece: bytes) -> None:
        receive(connection, piece)
        if connection._body_bytes >= connections.LEAST_BODY_BYTES:
            checked.append(len(piece))
            connection._check_body()

    monkeypatch.setattr(connections, "LEAST_BODY_BYTES", 1000)
    monkeypatch.setattr(connections.LimitedConnection, "on_body", receive_and_check)
    body = b"token=" + b"x" * 3000
    with connect(place) as connection:
        connection.sendall(
            b"POST /sign-in HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n"
            b"Content-Length: %d\r\n\r\n" % len(body)
        )
        for start in range(0, len(body), 1000):
            connection.sendall(body[start : start + 1000])
            time.sleep(0.05)  # pieces are received one by one
        assert rest_of(connection).startswith(b"HTTP/1.1 303")
    assert checked


def test_a_connection_serves_many_requests(place: Place) -> None:
    with httpx.Client(base_url=f"http://localhost:{place[1]}") as client:
        for _ in range(3):
            assert client.post("/v1/nowhere", content=b"x" * 100_000).status_code == 404
            assert client.get("/healthz").status_code == 200
