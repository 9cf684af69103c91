"""The service on PostgreSQL, of a real server that the test starts."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from calibgraph.service.jobs import JobTable
from tests.service.conftest import Make, Problem

pytestmark = pytest.mark.slow


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Postgres:
    """A server with its data in a folder; it refuses to run as root."""

    def __init__(self, folder: Path, programs: Path) -> None:
        self._folder, self._programs, self._port = folder, programs, free_port()
        self._user = {"user": "postgres"} if os.getuid() == 0 else {}
        if self._user:
            for path in (folder, *folder.parents):  # who may not enter one of them enters none
                if not (mode := path.stat().st_mode) & 0o001:
                    path.chmod(mode | 0o055)
            shutil.chown(folder, "postgres")
        self._run("initdb", "--auth=trust", "--username=calibgraph", "-D", str(folder / "data"))

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://calibgraph@127.0.0.1:{self._port}/postgres"

    def start(self) -> None:
        options = f"-p {self._port} -k {self._folder} -c listen_addresses=127.0.0.1"
        self._control("-o", options, "-l", str(self._folder / "log"), "start")

    def stop(self) -> None:
        self._control("-m", "immediate", "stop")

    def _control(self, *words: str) -> None:
        self._run("pg_ctl", "-D", str(self._folder / "data"), "-w", *words)

    def _run(self, program: str, *words: str) -> None:
        subprocess.run(
            [str(self._programs / program), *words],
            check=True, timeout=60, cwd=self._folder, stdout=subprocess.DEVNULL, **self._user,
        )  # fmt: skip


@pytest.fixture
def postgres(tmp_path: Path) -> Iterator[Postgres]:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    if not found:
        pytest.skip("no PostgreSQL: apt-get install postgresql")
    pytest.importorskip("psycopg")
    folder = tmp_path / "postgres"
    folder.mkdir()
    server = Postgres(folder, found[-1].parent)
    server.start()
    yield server
    server.stop()


def test_jobs_are_kept_by_postgresql(postgres: Postgres, make_server: Make, small: Problem) -> None:
    client = make_server(database=postgres.url, jobs_at_once=1)
    id = client.post("/v1/jobs/solve", files=small.files).json()["id"]
    job = client.get(f"/v1/jobs/{id}", params={"wait_s": 60}).json()
    assert (job["state"], job["verdict"]) == ("succeeded", "PASS")
    assert client.get(f"/v1/jobs/{id}/result").json()["verdict"] == "PASS"
    assert [each["id"] for each in client.get("/v1/jobs").json()["jobs"]] == [id]
    assert client.delete(f"/v1/jobs/{id}").status_code == 409


def test_a_database_that_is_away_for_a_while_loses_nothing(
    postgres: Postgres, make_server: Make, small: Problem
) -> None:
    client = make_server(database=postgres.url)
    first = client.post("/v1/jobs/solve", files=small.files).json()["id"]
    postgres.stop()  # as a crash does
    assert client.post("/v1/jobs/solve", files=small.files).status_code == 503
    assert client.get(f"/v1/jobs/{first}").status_code == 503
    assert client.get("/healthz").status_code == 503
    postgres.start()
    assert client.get(f"/v1/jobs/{first}").json()["state"] == "queued"
    assert client.post("/v1/jobs/solve", files=small.files).status_code == 202
    assert client.get("/healthz").status_code == 200


def test_a_job_that_a_server_left_running_waits_again(
    postgres: Postgres, make_server: Make, small: Problem
) -> None:
    client = make_server(database=postgres.url)
    id = client.post("/v1/jobs/solve", files=small.files).json()["id"]
    table: JobTable = client.app.state.service.jobs  # type: ignore[attr-defined]
    started = table.start_next()
    assert started is not None
    assert (started.id, started.state, table.start_next()) == (id, "running", None)
    assert table.put_back() == 1
    assert client.get(f"/v1/jobs/{id}").json()["state"] == "queued"
