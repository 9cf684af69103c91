"""Jobs over HTTP: taken in, run, followed, cancelled; what a result gives."""

import io
import zipfile
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from calibgraph import (
    Rig,
    calibrate,
    load_dataset,
    load_rig,
    simulate_correspondences,
    solve,
)
from calibgraph.service.app import create_app
from calibgraph.service.requests import Settings
from tests.conftest import SAMPLE, require_poses
from tests.service.conftest import URL, Make, Problem, service_folder
from tests.service.hostile import zipped

SOLVE = "/v1/jobs/solve"


def submit(client: TestClient, small: Problem, **data: str) -> Any:
    return client.post(SOLVE, files=small.files, data=data)


def poses_of(result: Any) -> dict[str, Any]:
    return {name: camera["T_camera_lidar"] for name, camera in result["cameras"].items()}


def text(value: str) -> tuple[None, str]:
    """A field of a form that is no file."""
    return None, value


@pytest.mark.parametrize(
    ("parts", "detail"),
    [
        ([("name", text("a"))], "'rig' is missing"),
        ([("rig", b"x")], "'correspondences' is missing"),
        ([("rig", text("x"))], "'rig' is a text; send it as a file"),
        ([("recording", b"x")], "unknown field 'recording'"),
        ([("rig", b"x"), ("rig", text("x"))], "'rig' is given 2 times"),
        ([("report", text("false"))], "unknown field 'report'; known are rig"),
        ([("settings", text("{"))], "JSON"),
        ([("settings", text("[" * 100_000))], "JSON"),
        ([("settings", text('{"evil": 1}'))], "evil"),
        ([("settings", text('{"config": {"tolerance_deg": -1}}'))], "tolerance_deg"),
        ([("name", text("x" * 101))], "name"),
    ],
)
def test_a_form_that_is_no_job_is_refused_in_one_line(
    make_server: Make, small: Problem, parts: list[Any], detail: str
) -> None:
    client = make_server()
    whole = [*small.files.items()] if parts[0][0] in ("settings", "name") else []
    answer = client.post(SOLVE, files=parts + whole * ("missing" not in detail))
    assert answer.status_code == 422 and detail in answer.json()["detail"], answer.text
    assert not list((service_folder(client) / "jobs").iterdir())
    assert not list((service_folder(client) / "arriving").iterdir())


def test_only_printable_characters_of_names_are_kept(make_server: Make, small: Problem) -> None:
    client = make_server()
    evil = "car\x1b[2J \x7f7\x9b \u202eevil\u2066\r\n<b>"
    assert submit(client, small, name=evil).json()["name"] == "car[2J 7 evil <b>"
    page = client.get("/").text
    assert "car[2J 7 evil &lt;b&gt;" in page and "<b>\n" not in page


def test_a_result_is_that_of_the_library(
    working: TestClient, solved: str, small: Problem, tmp_path: Path
) -> None:
    (tmp_path / "rig.yaml").write_bytes(small.rig)
    (tmp_path / "table.parquet").write_bytes(small.table)
    expected = solve(load_rig(tmp_path / "rig.yaml"), tmp_path / "table.parquet")
    found = working.get(f"/v1/jobs/{solved}/result").json()
    assert found["verdict"] == expected.verdict.status
    assert working.get(f"/v1/jobs/{solved}").json()["cannot_tell"] is False
    require_poses(poses_of(found), expected.rig.T_camera_lidar, atol=1e-12)


def test_a_result_has_files_and_a_sandboxed_report(working: TestClient, solved: str) -> None:
    at = f"/v1/jobs/{solved}"
    archive = zipfile.ZipFile(io.BytesIO(working.get(f"{at}/files.zip").content))
    assert {"calibration.yaml", "report.html"} <= set(archive.namelist())
    report = working.get(f"{at}/report.html")
    assert report.text.startswith("<!DOCTYPE html>")
    assert report.headers["content-security-policy"].startswith("sandbox")
    page = working.get("/").text
    assert f'href="{at}/report.html"' in page and "PASS" in page


def test_no_answer_has_a_path_of_the_server(
    working: TestClient, solved: str, small: Problem
) -> None:
    folder = str(service_folder(working))
    failing = working.post(SOLVE, files={**small.files, "rig": b"cameras: 7"}).json()["id"]
    failed = working.get(f"/v1/jobs/{failing}", params={"wait_s": 60}).json()
    assert failed["error_kind"] == "bad input"
    assert "rig.yaml" in failed["error"]
    for id in (solved, failing):
        for part in ("", "/log", "/result", "/report.html", "/files.zip"):
            assert folder not in working.get(f"/v1/jobs/{id}{part}").text
    assert working.get(f"/v1/jobs/{failing}/result").status_code == 409
    left = {path.name for path in (service_folder(working) / "jobs" / failing).iterdir()}
    assert left == {"log.txt"}


def test_a_full_queue_refuses_and_gives_a_time_and_a_waiting_job_is_cancelled_once(
    make_server: Make, small: Problem
) -> None:
    client = make_server(most_queued=1)
    taken, refused = submit(client, small), submit(client, small)
    at = taken.headers["location"]
    assert (taken.status_code, at) == (202, f"/v1/jobs/{taken.json()['id']}")
    assert refused.status_code == 429 and int(refused.headers["retry-after"]) > 0
    assert client.post(SOLVE, content=b"no form").status_code == 429  # before it is read
    assert len(list((service_folder(client) / "jobs").iterdir())) == 1
    assert client.delete(at).json()["state"] == "cancelled"
    assert client.delete(at).status_code == 409


def test_jobs_survive_the_server_and_have_pages(tmp_path: Path, small: Problem) -> None:
    settings = Settings(data=tmp_path / "data", jobs_at_once=0, free_bytes=0)
    with TestClient(create_app(settings), URL) as client:
        ids = [submit(client, small).json()["id"] for _ in range(3)]
    with TestClient(create_app(settings), URL) as client:
        first = client.get("/v1/jobs", params={"limit": 2}).json()
        second = client.get("/v1/jobs", params={"limit": 2, "before": first["next"]}).json()
    assert [job["id"] for job in first["jobs"] + second["jobs"]] == ids[::-1]
    assert second["next"] is None


def test_old_results_expire(make_server: Make, small: Problem) -> None:
    client = make_server(keep_s=1e-6)
    at = submit(client, small).headers["location"]
    client.delete(at)
    later = submit(client, small).json()["id"]
    assert client.get(at).status_code == 404
    assert [path.name for path in (service_folder(client) / "jobs").iterdir()] == [later]


def zip_of_the_sample(*stems: str) -> bytes:
    """The files of the sample with these stems."""
    files = [path for path in sorted(SAMPLE.rglob("*")) if path.stem in stems]
    return zipped({str(path.relative_to(SAMPLE.parent)): path.read_bytes() for path in files})


def test_a_recording_is_calibrated_as_by_the_library_and_a_check_has_its_page(
    working: TestClient, tmp_path: Path
) -> None:
    """One camera, in two frames, which cannot tell; the deployed result was made from them."""
    rig, table = tmp_path / "rig.yaml", tmp_path / "table.parquet"
    left, truth = (load_rig(path).cameras["left"] for path in (SAMPLE, SAMPLE / "reference.yaml"))
    Rig(cameras={"left": left}).save(rig)
    simulate_correspondences(Rig(cameras={"left": truth}), frames=2).save(table)
    frames = load_dataset(SAMPLE, load_rig(rig), frames="0:2")
    expected = calibrate(frames, matcher=table)
    recording = {"recording": zip_of_the_sample("rig", "000000", "000001")}
    files = {**recording, "rig": rig.read_bytes(), "correspondences": table.read_bytes()}
    at = working.post("/v1/jobs/calibrate", files=files).headers["location"]
    assert working.get(at, params={"wait_s": 60}).json()["finished"]
    found = working.get(f"{at}/result").json()
    require_poses(poses_of(found), expected.T_camera_lidar, atol=1e-9)
    archive = zipfile.ZipFile(io.BytesIO(working.get(f"{at}/files.zip").content))
    files = {**recording, "rig": archive.read("calibration.yaml")}
    at = working.post("/v1/jobs/check", files=files).headers["location"]
    job = working.get(at, params={"wait_s": 60}).json()
    page = working.get(f"{at}/report.html").text
    assert job["verdict"] in page and "data:image/jpeg" in page
    result = working.get(f"{at}/result").json()
    stated = expected.verdict.status
    assert (result["same_recording"], result["deployed_verdict"]) == (True, stated)
