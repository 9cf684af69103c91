"""The server as a process: connections that want to harm, kill -9, SIGTERM, a full disk."""

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from tests.service.conftest import ONE_EACH, Problem
from tests.service.serving import SHORT, Server, frames_as_lines

HALF_REQUESTS = (
    b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ",
    b"POST /v1/trackers/a HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\nab",
)


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    found = Server(tmp_path / "data", *ONE_EACH, program=("-c", SHORT))
    found.start()
    yield found
    found.http.close()
    with suppress(psutil.NoSuchProcess):
        found.end(signal.SIGKILL)


def rest_of(connection: socket.socket) -> bytes:
    """All until the server ends the connection."""
    found = b""
    with suppress(ConnectionResetError):
        while some := connection.recv(65536):
            found += some
    return found


def seconds_of_a_request(server: Server) -> float:
    start = time.perf_counter()
    with server.connect() as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert rest_of(connection).startswith(b"HTTP/1.1 200")
    return time.perf_counter() - start


@pytest.mark.slow
def test_who_sends_a_byte_now_and_then_is_cut_off_too(server: Server) -> None:
    for begin in HALF_REQUESTS:
        with server.connect() as connection, suppress(ConnectionResetError, BrokenPipeError):
            connection.sendall(begin)
            start = time.monotonic()
            while time.monotonic() - start < 30:
                connection.sendall(b"x")
                time.sleep(0.2)
            pytest.fail("the connection stayed open")


@pytest.mark.slow
def test_a_body_that_is_answered_before_its_end_holds_nothing(server: Server) -> None:
    """A queue that nobody reads must not hold the connection, nor the requests after it."""
    before = server.memory_mb()
    for _ in range(30):
        answer = server.http.post("/v1/jobs/nothing", content=bytes(3_000_000))
        assert answer.status_code == 422
    assert server.memory_mb() < before + 50
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/jobs/nothing HTTP/1.1\r\nHost: localhost\r\n"
            b"Content-Length: 10000000000\r\n\r\n"
            b"Content-Length: 10000000000\r\n\r\n"
        )
        start = time.monotonic()
        with suppress(ConnectionResetError, BrokenPipeError):
            while time.monotonic() - start < 30:
                connection.sendall(b"x" * 65536)
            pytest.fail("the connection stayed open")
    assert seconds_of_a_request(server) < 5


@pytest.mark.slow
def test_a_kill_in_the_middle_of_a_job_and_of_frames_loses_nothing(
    server: Server, small: Problem
) -> None:
    frames = frames_as_lines(small.table)
    assert server.http.put("/v1/trackers/car", content=small.rig).status_code == 200
    ids = [server.http.post("/v1/jobs/solve", files=small.files).json()["id"] for _ in range(3)]
    acknowledged = -1
    for number, frame in enumerate(frames[:5]):
        server.http.post("/v1/trackers/car", content=frame).raise_for_status()
        acknowledged = number
    end = time.monotonic() + 60
    while server.http.get(f"/v1/jobs/{ids[0]}").json()["state"] == "queued":
        assert time.monotonic() < end
    children = server.process.children(recursive=True)
    server.end(signal.SIGKILL)
    _, alive = psutil.wait_procs(children, 20)
    assert not alive
    server.start()
    assert server.http.get("/v1/trackers/car").json()["frame"] == acknowledged
    again = server.http.post("/v1/trackers/car", content=b"".join(frames)).json()
    assert (again["known"], len(again["updates"])) == (acknowledged + 1, len(frames) - 5)
    for id in ids:
        job = server.wait_for(f"/v1/jobs/{id}")
        assert (job["state"], job["verdict"]) == ("succeeded", "PASS")
    assert [job["id"] for job in server.http.get("/v1/jobs").json()["jobs"]] == ids[::-1]


@pytest.mark.slow
def test_a_job_whose_process_dies_runs_again_and_sigterm_ends_in_time(
    server: Server, small: Problem
) -> None:
    at = server.http.post("/v1/jobs/solve", files=small.files).headers["location"]
    for child in server.process.children(recursive=True):
        child.kill()
    assert server.wait_for(at)["state"] == "succeeded"
    late = server.http.post("/v1/jobs/solve", files=small.files).headers["location"]
    start = time.monotonic()
    server.end(signal.SIGTERM)
    assert time.monotonic() - start < 30 and server.process.returncode == 0
    server.start()
    assert server.wait_for(late)["state"] == "succeeded"


@pytest.mark.slow
def test_a_client_that_goes_half_way_leaves_nothing(server: Server, tmp_path: Path) -> None:
    with server.connect() as connection:
        connection.sendall(
            b"POST /v1/jobs/solve HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000000\r\n"
            b"Content-Type: multipart/form-data; boundary=b\r\n\r\n--b\r\n"
            b'Content-Disposition: form-data; name="rig"; filename="r"\r\n\r\n' + bytes(3_000_000)
        )
        time.sleep(0.5)
    time.sleep(1)
    assert not list((tmp_path / "data" / "arriving").iterdir())
    opened = {os.readlink(fd) for fd in Path(f"/proc/{server.process.pid}/fd").iterdir()}
    assert not [path for path in opened if "arriving" in path]
    assert server.http.get("/v1/jobs").json()["jobs"] == []
