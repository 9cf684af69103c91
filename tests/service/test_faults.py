"""Faults: a full disk, a broken database, a clock that jumps, a client that goes, a dead worker."""

import errno
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from calibgraph.errors import CalibrationError
from calibgraph.service import state
from calibgraph.service.app import create_app
from calibgraph.service.jobs import DATABASE
from calibgraph.service.requests import Settings
from tests.service.conftest import URL, Make, Problem, service_folder


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_acknowledges_nothing(
    make_server: Make, small: Problem, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    client = make_server()

    def full(*_: object) -> None:
        raise OSError(number, "no space left")

    with monkeypatch.context() as patch:
        patch.setattr(state, "sync_to_disk", full)
        answer = client.post("/v1/jobs/solve", files=small.files)
    assert answer.status_code == 507
    assert client.get("/v1/jobs").json()["jobs"] == []
    assert not list((service_folder(client) / "arriving").iterdir())
    assert client.post("/v1/jobs/solve", files=small.files).status_code == 202


def test_an_almost_full_disk_takes_nothing_in(make_server: Make, small: Problem) -> None:
    client = make_server(free_bytes=10**18)
    assert client.post("/v1/jobs/solve", files=small.files).status_code == 507
    assert client.get("/healthz").status_code == 507


def test_a_database_that_cannot_be_read_at_the_start_is_named(tmp_path: Path) -> None:
    data = tmp_path / "data"
    data.mkdir()
    (data / DATABASE).write_bytes(b"this is no database" * 100)
    with pytest.raises(CalibrationError, match="cannot be opened") as caught:
        create_app(Settings(data=data))
    assert "\n" not in str(caught.value)


def test_a_database_that_fails_later_is_503_and_heals(
    make_server: Make, small: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = make_server()
    id = client.post("/v1/jobs/solve", files=small.files).json()["id"]
    app: Any = client.app

    def broken(*_: object, **__: object) -> Any:
        raise sqlite3.OperationalError("disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr(app.state.service.jobs, "run", broken)
        statuses = {
            client.get(f"/v1/jobs/{id}").status_code,
            client.post("/v1/jobs/solve", files=small.files).status_code,
            client.get("/healthz").status_code,
        }
    assert statuses == {503}
    assert client.get(f"/v1/jobs/{id}").json()["state"] == "queued"


def test_two_servers_do_not_share_a_folder(tmp_path: Path) -> None:
    settings = Settings(data=tmp_path / "data", jobs_at_once=0)
    with TestClient(create_app(settings), URL), pytest.raises(CalibrationError, match="in use"):
        create_app(settings)
