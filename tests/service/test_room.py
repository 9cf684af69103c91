"""Room: what was refused, failed or cancelled leaves nothing; no tenant takes that of another."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.testclient import TestClient

from calibgraph.service import connections
from calibgraph.service.app import create_app
from calibgraph.service.folders import DataFolder
from calibgraph.service.settings import Settings
from tests.service.conftest import URL, Make, Problem, make_tokens, service_folder
from tests.service.hostile import zipped
from tests.service.ports import on_a_port

MB = 10**6
With = tuple[tuple[str, int], list[dict[str, str]]]
ROOM_BYTES = 300 * MB
HEAD = b"Content-Type: multipart/form-data; boundary=b\r\n"
BEGIN = b'--b\r\nContent-Disposition: form-data; name="recording"; filename="r"\r\n\r\n'


@pytest.fixture
def with_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[With]:
    """A server of two tenants and their headers, on a disk with ROOM_BYTES that nobody shares."""
    headers = make_tokens(tmp_path / "tokens.yaml", ("a", "submit"), ("b", "submit"))
    data = tmp_path / "data"
    monkeypatch.setattr(DataFolder, "free_bytes", lambda _: ROOM_BYTES - size_of(data))
    settings = Settings(data=data, tokens=tmp_path / "tokens.yaml", jobs_at_once=0, free_bytes=0)
    with on_a_port(settings) as (host, port, _):
        yield (host, port), headers


def begin_upload(place: tuple[str, int], token: dict[str, str], how: bytes) -> socket.socket:
    connection = socket.create_connection(place)
    connection.settimeout(60)
    bearer = f"Authorization: {token['Authorization']}\r\n".encode()
    head = b"POST /v1/calibrations HTTP/1.1\r\nHost: localhost\r\n" + bearer + HEAD + how
    connection.sendall(head + b"\r\n\r\n")
    return connection


def submit(place: tuple[str, int], token: dict[str, str], small: Problem) -> int:
    url = f"http://localhost:{place[1]}/v1/solves"
    return httpx.post(url, files=small.files, headers=token, timeout=60).status_code


@pytest.mark.parametrize("size", [1000 * MB, 200 * MB, 10**15, 10**30])
def test_an_upload_without_room_is_refused_before_it_is_sent_and_others_are_not(
    with_room: With, small: Problem, size: int
) -> None:
    place, (first, second) = with_room
    with begin_upload(place, first, b"Content-Length: %d" % size) as connection:
        assert connection.recv(12) in (b"HTTP/1.1 507", b"HTTP/1.1 413", b"HTTP/1.1 400")
        assert submit(place, second, small) == 202


def test_uploads_that_arrive_keep_their_room_and_leave_some_to_others(
    with_room: With, small: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "BODY_S", 600.0)
    place, (first, second) = with_room
    with begin_upload(place, first, b"Content-Length: %d" % (120 * MB)) as held:
        held.sendall(BEGIN)
        end = time.monotonic() + 60
        while not list((tmp_path / "data" / "arriving").glob("*/*/*")):
            assert time.monotonic() < end
            time.sleep(0.01)
        with begin_upload(place, first, b"Content-Length: %d" % (120 * MB)) as connection:
            assert connection.recv(12) == b"HTTP/1.1 507"
        assert submit(place, second, small) == 202


def test_a_body_without_a_length_ends_where_its_room_does(
    with_room: With, small: Problem, tmp_path: Path
) -> None:
    place, (first, second) = with_room
    with begin_upload(place, first, b"Transfer-Encoding: chunked") as connection:
        connection.sendall(b"%x\r\n%s\r\n" % (len(BEGIN), BEGIN))
        sent, piece = 0, bytes(MB)
        with suppress(OSError):
            while sent < ROOM_BYTES:
                connection.sendall(b"%x\r\n%s\r\n" % (len(piece), piece))
                sent += len(piece)
        assert connection.recv(12) == b"HTTP/1.1 507"
        assert submit(place, second, small) == 202
    assert not list((tmp_path / "data" / "arriving").iterdir())


def test_frames_of_one_tenant_leave_memory_to_others(
    make_server: Make, small: Problem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibgraph.service.state.MAX_BODIES_BYTES", 10_000)
    client = make_server()
    kind = {"Content-Type": "application/json"}
    assert client.post("/v1/solves", content=b" " * 6000, headers=kind).status_code == 429
    assert client.post("/v1/solves", content=b" " * 4000, headers=kind).status_code == 400


BOMBS = {
    "ratio": {"lidar/000000.npy": bytes(300 * MB)},
    "size": {f"lidar/{i}.npy": bytes(30 * MB) for i in range(3)},
}


@pytest.mark.parametrize("name", [pytest.param("ratio", marks=pytest.mark.slow), "size"])
def test_a_bomb_is_refused_before_it_is_unpacked_and_leaves_nothing(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = 1000 * MB if name == "ratio" else 70 * MB
    settings = Settings(
        data=tmp_path / "data", jobs_at_once=1, tracker_processes=0, free_bytes=0,
        upload_bytes=limit,
    )  # fmt: skip
    with TestClient(create_app(settings), URL) as client:
        sizes = []
        at = client.post("/v1/calibrations", files={"recording": zipped(BOMBS[name])}).headers[
            "location"
        ]
        while (job := client.get(at, params={"wait_s": 0.05}).json())["state"] in (
            "queued", "running",
        ):  # fmt: skip
            sizes.append(size_of(service_folder(client) / "jobs"))
        assert job["state"] == "failed"
        assert "unpacked" in job["error"]["detail"]
        assert max(sizes, default=0) < 2 * MB
        assert size_of(service_folder(client) / "jobs") < 10_000


def size_of(folder: Path) -> int:
    """Bytes of the files in a folder, some of which may be gone meanwhile."""
    size = 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):
            size += path.stat().st_size if path.is_file() else 0
    return size


def names_of(client: TestClient, at: str) -> set[str]:
    """What lies in the folder of a job."""
    folder = service_folder(client) / "jobs" / Path(at).name
    return {path.name for path in folder.iterdir()}


def test_a_finished_job_keeps_its_result_and_log_alone(
    working: TestClient, solved: str, small: Problem
) -> None:
    assert names_of(working, solved) == {"result", "log.txt"}
    failing = working.post("/v1/solves", files={**small.files, "rig": b"cameras: 7"})
    at = failing.headers["location"]
    assert working.get(at, params={"wait_s": 60}).json()["state"] == "failed"
    assert names_of(working, at) == {"log.txt"}


def test_a_cancelled_job_keeps_its_log_alone(make_server: Make, small: Problem) -> None:
    client = make_server()
    at = client.post("/v1/solves", files=small.files).headers["location"]
    client.delete(at)
    assert names_of(client, at) == {"log.txt"}


def test_what_a_killed_server_left_goes_at_the_next_start(
    make_server: Make, small: Problem, tmp_path: Path
) -> None:
    with TestClient(create_app(Settings(data=tmp_path / "d", jobs_at_once=0)), URL) as client:
        at = client.post("/v1/solves", files=small.files).headers["location"]
        client.delete(at)
        folder = service_folder(client)
        for left in (
            f"jobs/{at.rsplit('/')[-1]}/input",
            "jobs/unknown/input",
            "arriving/x/input",
            "trackers/x",
        ):
            (folder / left).mkdir(parents=True)
            (folder / left / "recording").write_bytes(bytes(1000))
    app: Any = create_app(Settings(data=tmp_path / "d", jobs_at_once=0))
    with TestClient(app, URL):
        kept = [size_of(folder / name) for name in ("jobs", "arriving", "trackers")]
        assert kept == [0, 0, 0]
