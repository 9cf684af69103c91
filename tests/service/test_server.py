"""The server as a process: connections that want to harm, kill -9, SIGTERM, a full disk."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import psutil
import pytest

from tests.service.conftest import Problem, frames_as_lines

HALF_REQUESTS = (
    b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: ",
    b"POST /v1/trackers/a HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\nab",
)
SHORT = (
    "from calibgraph.service import app, request_guard;"
    "request_guard.BODY_S = app.IDLE_S = 2.0;"
    "from calibgraph.cli.app import main; main()"
)
"""The command with shorter waits."""


class Server:
    """``calibgraph serve`` as a process of its own, on a port that stays."""

    def __init__(self, data: Path, *options: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._words = ["serve", "--data", str(data), "--port", str(self.port), "--free-gb", "0",
                       "--jobs", "1", "--tracker-processes", "1", *options]  # fmt: skip
        self._log = data.with_suffix(".log")
        self.http = httpx.Client(base_url=f"http://127.0.0.1:{self.port}", timeout=120)

    def start(self) -> None:
        command = [sys.executable, "-c", SHORT, *self._words]
        with self._log.open("ab") as log:
            self.process = psutil.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
        end = time.monotonic() + 120
        while time.monotonic() < end:
            with suppress(httpx.HTTPError):
                if self.http.get("/healthz").status_code == 200:
                    return
            time.sleep(0.1)
        raise AssertionError(self._log.read_text())

    def end(self, number: int) -> None:
        self.process.send_signal(number)
        self.process.wait(60)

    def connect(self) -> socket.socket:
        connection = socket.create_connection(("127.0.0.1", self.port))
        connection.settimeout(60)
        return connection

    def memory_mb(self) -> float:
        return float(self.process.memory_info().rss / 1e6)

    def wait_for(self, at: str) -> dict[str, object]:
        """A job when it is finished."""
        for _ in range(10):
            job: dict[str, object] = self.http.get(at, params={"wait_s": 60}).json()
            if job["finished"]:
                break
        return job


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    found = Server(tmp_path / "data")
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
