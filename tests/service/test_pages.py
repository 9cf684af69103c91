"""Pages for people: what they show, who sees them, that nothing in them is run."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

from starlette.testclient import TestClient

from calibgraph.service.requests import CalibrationSettings
from tests.conftest import SAMPLE, CommandRun
from tests.service.conftest import Make, Problem, make_tokens, service_folder


def test_a_list_of_jobs_has_verdicts_and_leads_to_them(working: TestClient, solved: str) -> None:
    assert f'href="/jobs/{solved}"' in working.get("/").text
    page = working.get(f"/jobs/{solved}").text
    assert '<section class="verdict PASS">' in page
    assert f"/v1/jobs/{solved}/report.html" in page
    assert f"/v1/jobs/{solved}/exports/ros2-launch" in page


def test_text_of_users_is_escaped(make_server: Make, small: Problem) -> None:
    client = make_server()
    id = client.post("/v1/solves", files=small.files).json()["id"]
    service = client.app.state.service  # type: ignore[attr-defined]
    service.jobs.start_next()
    service.jobs.finish(id, "failed", error_kind="bad input", error="<script>alert(1)</script>")
    for page in (client.get("/").text, client.get(f"/jobs/{id}").text):
        assert "<script>alert" not in page
        assert "&lt;script&gt;" in page


def test_a_name_and_a_note_are_shown_and_escaped(make_server: Make, small: Problem) -> None:
    client = make_server()
    about = {"name": "<b>car 7", "note": "after the <i>repair"}
    answer = client.post("/v1/solves", files=small.files, data=about).json()
    assert (answer["name"], answer["note"]) == ("<b>car 7", "after the <i>repair")
    assert client.get("/v1/jobs").json()["jobs"][0]["name"] == "<b>car 7"
    for page in (client.get("/").text, client.get(f"/jobs/{answer['id']}").text):
        assert "&lt;b&gt;car 7" in page and "after the &lt;i&gt;repair" in page
        assert "<b>car" not in page and "<i>" not in page
    too_long = client.post("/v1/solves", files=small.files, data={"name": "x" * 101})
    assert too_long.status_code == 422 and "name" in too_long.json()["detail"]


def test_a_form_without_a_script_takes_in_a_job(make_server: Make, small: Problem) -> None:
    """A browser sends fields that were left empty, and files that were not chosen."""
    client = make_server()
    form = client.get("/new/calibration").text
    for name in ("recording", "rig", "name", "note", "frames", "search_deg"):
        assert f'name="{name}"' in form
    files = {"recording": ("a.zip", b"PK"), "rig": ("", b"")}
    data = {"name": "first", "note": "", "frames": "0:4", "search_deg": "3.5", "search_m": ""}
    answer = client.post("/new/calibration", files=files, data=data)
    assert answer.status_code == 303
    place = answer.headers["location"]
    assert "first: can this calibration be used?" in client.get(place).text
    id = place.removeprefix("/jobs/")
    job = client.app.state.service.jobs.request(id)  # type: ignore[attr-defined]
    settings = CalibrationSettings.model_validate(job.settings)
    assert (settings.frames, settings.search_deg, settings.search_m) == ("0:4", 3.5, None)
    assert {path.name for path in (service_folder(client) / "jobs" / id / "input").iterdir()} == {
        "recording"
    }


def test_a_form_that_is_refused_is_shown_again_with_the_reason(
    make_server: Make, small: Problem
) -> None:
    client = make_server()
    files = {"rig": ("rig.yaml", small.rig), "recording": ("a.zip", b"PK")}
    answer = client.post("/new/check", files=files, data={"tolerance_deg": "-1"})
    assert answer.status_code == 422
    assert 'role="alert"' in answer.text and "tolerance_deg" in answer.text
    assert "Check a deployed calibration" in answer.text
    assert client.get("/v1/jobs").json()["jobs"] == []


def test_reading_is_not_enough_for_a_form(
    make_server: Make, tmp_path: Path, small: Problem
) -> None:
    path = tmp_path / "tokens.yaml"
    (reader,) = make_tokens(path, ("ours", "read"))
    client = make_server(tokens=path)
    assert client.post("/new/solve", files=small.files).headers["location"] == "/sign-in"
    token = reader["Authorization"].removeprefix("Bearer ")
    client.post("/sign-in", data={"token": token})
    assert client.post("/new/solve", files=small.files).status_code == 403


def two_frames() -> bytes:
    """A zip of the sample's first two frames."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w") as archive:
        for path in sorted(SAMPLE.rglob("*")):
            if path.is_file() and path.stem in ("rig", "000000", "000001"):
                archive.write(path, path.relative_to(SAMPLE))
    return held.getvalue()


def test_a_check_has_its_page(working: TestClient, calibrated_sample: CommandRun) -> None:
    """Of two frames, which cannot tell; the deployed result was made from them."""
    deployed = (calibrated_sample.folder / "calibration.yaml").read_bytes()
    files = {"rig": deployed, "recording": two_frames()}
    id = working.post("/v1/checks", files=files, data={"name": "monday"}).json()["id"]
    verdict = working.get(f"/v1/jobs/{id}", params={"wait_s": 60}).json()["verdict"]
    job = working.get(f"/jobs/{id}").text
    assert "monday: is the deployed calibration still right?" in job
    assert f'href="/v1/jobs/{id}/report.html"' in job and "/exports/" not in job
    page = working.get(f"/v1/jobs/{id}/report.html")
    assert f'<strong class="big">{verdict}</strong>' in page.text
    assert page.text.count("data:image/jpeg") >= 3
    assert "sandbox" in page.headers["content-security-policy"]
    assert working.get(f"/v1/jobs/{id}/exports/ros2").status_code == 404
    result = working.get(f"/v1/jobs/{id}/result").json()
    assert result["same_recording"] is True
    assert result["deployed_verdict"] == "PASS"


def test_a_check_of_mounts_is_refused(working: TestClient, calibrated_sample: CommandRun) -> None:
    result = (calibrated_sample.folder / "calibration.yaml").read_text("utf-8")
    deployed = result.replace("of: alignment", "of: mount").encode()
    files = {"rig": deployed, "recording": two_frames()}
    id = working.post("/v1/checks", files=files).json()["id"]
    job = working.get(f"/v1/jobs/{id}", params={"wait_s": 60}).json()
    assert job["state"] == "failed" and "poses of the mount" in job["error"]["detail"]


def test_a_browser_signs_in_with_a_token(make_server: Make, tmp_path: Path, small: Problem) -> None:
    path = tmp_path / "tokens.yaml"
    ours, other = make_tokens(path, ("ours", "read"), ("theirs", "submit"))
    client = make_server(tokens=path)
    id = client.post("/v1/solves", files=small.files, headers=other).json()["id"]
    assert client.get("/").headers["location"] == "/sign-in"
    assert client.post("/sign-in", data={"token": "wrong"}).status_code == 403
    token = ours["Authorization"].removeprefix("Bearer ")
    cookie = client.post("/sign-in", data={"token": token}).headers["set-cookie"]
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert client.get("/").status_code == 200
    assert client.get(f"/jobs/{id}").status_code == 404
    client.post("/sign-out")
    assert client.get("/").status_code == 303


def test_the_api_is_described_without_a_network(make_server: Make) -> None:
    page = make_server().get("/docs").text
    assert "POST /v1/calibrations" in page
    assert "https://" not in page
