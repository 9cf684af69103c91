"""Jobs over HTTP: taken in once, run, followed, cancelled; what a result gives."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import inspect, text
from starlette.testclient import TestClient

from calibgraph import load_rig, solve
from calibgraph.service.app import create_app
from calibgraph.service.database import open_database
from calibgraph.service.folders import DataFolder
from calibgraph.service.jobs import JobTable
from calibgraph.service.settings import Settings
from tests.service.conftest import URL, Make, Problem, service_folder


def submit(client: TestClient, small: Problem, **headers: str) -> Any:
    return client.post("/v1/solves", files=small.files, headers=headers)


def test_a_job_is_acknowledged_with_its_place(make_server: Make, small: Problem) -> None:
    answer = submit(make_server(), small)
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    assert answer.json()["state"] == "queued"


def test_a_setting_of_the_solve_as_a_field_is_told_where_it_goes(
    make_server: Make, small: Problem
) -> None:
    client, field = make_server(), {"tolerance_deg": "0.3"}
    answer = client.post("/v1/solves", files=small.files, data=field)
    assert answer.status_code == 422
    told = answer.json()["detail"].partition("settings=")[2]
    given = json.dumps({"config": {"tolerance_deg": 0.3}})
    assert told == given.replace("0.3", '"..."')
    data = {"settings": given, "report": "false"}
    assert client.post("/v1/solves", files=small.files, data=data).status_code == 202


def test_a_result_is_that_of_the_library(
    working: TestClient, solved: str, small: Problem, tmp_path: Path
) -> None:
    (tmp_path / "rig.yaml").write_bytes(small.rig)
    (tmp_path / "table.parquet").write_bytes(small.table)
    expected = solve(load_rig(tmp_path / "rig.yaml"), tmp_path / "table.parquet")
    found = working.get(f"/v1/jobs/{solved}/result").json()
    assert found["verdict"] == expected.verdict.status
    for name, camera in expected.rig.cameras.items():
        T = np.array(found["cameras"][name]["T_camera_lidar"])
        np.testing.assert_allclose(T, camera.T_camera_lidar, rtol=0, atol=1e-12)


def test_a_result_has_files_a_report_and_exports(working: TestClient, solved: str) -> None:
    at = f"/v1/jobs/{solved}"
    archive = zipfile.ZipFile(io.BytesIO(working.get(f"{at}/files.zip").content))
    assert {"calibration.yaml", "report.html"} <= set(archive.namelist())
    report = working.get(f"{at}/report.html")
    assert report.text.startswith("<!DOCTYPE html>")
    assert "sandbox" in report.headers["content-security-policy"]
    assert b"<robot" in working.get(f"{at}/exports/urdf").content
    infos = zipfile.ZipFile(io.BytesIO(working.get(f"{at}/exports/camera_info").content))
    assert {name.removesuffix(".yaml") for name in infos.namelist()} == {"left", "right"}
    assert working.get(f"{at}/exports/nonsense").status_code == 404


def test_a_job_states_whether_the_data_could_tell(working: TestClient, solved: str) -> None:
    assert working.get(f"/v1/jobs/{solved}").json()["cannot_tell"] is False


def test_a_database_of_before_that_field_gets_its_column(tmp_path: Path) -> None:
    engine = open_database(tmp_path, None, "owner")
    with engine.begin() as connection:
        for column in ("cannot_tell", "name", "note"):
            connection.execute(text(f"ALTER TABLE jobs DROP COLUMN {column}"))
    engine.dispose()
    engine = open_database(tmp_path, None, "owner")
    held = {column["name"] for column in inspect(engine).get_columns("jobs")}
    assert {"cannot_tell", "name", "note"} <= held
    assert JobTable(engine).states() == {}
    engine.dispose()


def test_events_end_with_the_result(working: TestClient, solved: str) -> None:
    lines = working.get(f"/v1/jobs/{solved}/events").text.splitlines()
    assert lines[0] == "event: succeeded"
    assert json.loads(lines[1].removeprefix("data: "))["verdict"] == "PASS"


def test_no_answer_has_a_path_of_the_server(
    working: TestClient, solved: str, small: Problem
) -> None:
    folder = str(service_folder(working))
    failing = working.post("/v1/solves", files={**small.files, "rig": b"cameras: 7"}).json()["id"]
    failed = working.get(f"/v1/jobs/{failing}", params={"wait_s": 60}).json()
    assert failed["error"]["kind"] == "bad input"
    assert "rig.yaml" in failed["error"]["detail"]
    for id in (solved, failing):
        for part in ("", "/log", "/result", "/report.html", "/files.zip"):
            assert folder not in working.get(f"/v1/jobs/{id}{part}").text
    assert working.get(f"/v1/jobs/{failing}/result").status_code == 409


def test_a_key_gives_the_first_job_again(make_server: Make, small: Problem) -> None:
    client = make_server()
    first = submit(client, small, **{"Idempotency-Key": "a"}).json()
    assert submit(client, small, **{"Idempotency-Key": "a"}).json() == first
    other = client.post(
        "/v1/solves",
        files={**small.files, "rig": small.rig + b"\n"},
        headers={"Idempotency-Key": "a"},
    )
    assert other.status_code == 422
    assert len(client.get("/v1/jobs").json()["jobs"]) == 1


def test_a_full_queue_refuses_and_gives_a_time(make_server: Make, small: Problem) -> None:
    client = make_server(most_queued=1)
    assert submit(client, small).status_code == 202
    refused = submit(client, small)
    assert refused.status_code == 429
    assert int(refused.headers["retry-after"]) > 0


def test_a_waiting_job_can_be_cancelled_once(make_server: Make, small: Problem) -> None:
    client = make_server()
    at = submit(client, small).headers["location"]
    assert client.delete(at).json()["state"] == "cancelled"
    assert client.delete(at).status_code == 409


def test_jobs_survive_the_server(tmp_path: Path, small: Problem) -> None:
    settings = Settings(data=tmp_path / "data", jobs_at_once=0, free_bytes=0)
    with TestClient(create_app(settings), URL) as client:
        id = submit(client, small).json()["id"]
    with TestClient(create_app(settings), URL) as client:
        assert [job["id"] for job in client.get("/v1/jobs").json()["jobs"]] == [id]


def test_a_list_has_pages(make_server: Make, small: Problem) -> None:
    client = make_server()
    ids = [submit(client, small).json()["id"] for _ in range(3)]
    first = client.get("/v1/jobs", params={"limit": 2}).json()
    second = client.get("/v1/jobs", params={"limit": 2, "before": first["next"]}).json()
    assert [job["id"] for job in first["jobs"] + second["jobs"]] == ids[::-1]
    assert second["next"] is None


def test_old_results_expire(make_server: Make, small: Problem) -> None:
    client = make_server(keep_s=1e-6)
    at = submit(client, small).headers["location"]
    client.delete(at)
    client.app.state.service.runner.remove_expired()  # type: ignore[attr-defined]
    assert client.get(at).status_code == 404
    assert not list((service_folder(client) / "jobs").iterdir())


@pytest.mark.parametrize("part", ["result", "report.html", "files.zip", "exports/urdf"])
def test_a_result_that_expires_meanwhile_is_of_no_job(
    working: TestClient, solved: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, part: str
) -> None:
    """The job was found; its folder is not."""
    monkeypatch.setattr(DataFolder, "of_job", lambda *_: tmp_path)
    answer = working.get(f"/v1/jobs/{solved}/{part}")
    assert answer.status_code == 404 and answer.json()["detail"].startswith("no such job")


def test_a_report_that_goes_before_it_is_sent_is_no_error(
    working: TestClient, solved: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(DataFolder, "of_job", lambda *_: tmp_path)
    monkeypatch.setattr(Path, "exists", lambda _: True)
    assert working.get(f"/v1/jobs/{solved}/report.html").status_code == 404


def test_uris_are_read_inside_roots_alone(
    make_server: Make, small: Problem, tmp_path: Path
) -> None:
    inside = tmp_path / "drives"
    inside.mkdir()
    (inside / "rig.yaml").write_bytes(small.rig)
    (inside / "table.parquet").write_bytes(small.table)
    (tmp_path / "secret.yaml").write_bytes(small.rig)
    (inside / "link.yaml").symlink_to(tmp_path / "secret.yaml")
    client = make_server(roots=(str(inside),))

    def status(rig: str) -> int:
        body = {"rig": rig, "correspondences": str(inside / "table.parquet")}
        return client.post("/v1/solves", json=body).status_code

    assert status(str(inside / "rig.yaml")) == 202
    outside = ("../secret.yaml", "link.yaml", "%2e%2e/secret.yaml", "gone.yaml")
    assert [status(f"{inside}/{name}") for name in outside] == [422] * 4
    assert [status(uri) for uri in ("file:///etc/passwd", "http://10.0.0.1/a")] == [422, 422]
