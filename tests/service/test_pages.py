"""Pages for people: what they show, who sees them, that nothing in them is run."""

from __future__ import annotations

from pathlib import Path

from starlette.testclient import TestClient

from tests.service.conftest import Make, Problem, make_tokens


def test_a_list_of_jobs_has_verdicts_and_leads_to_them(working: TestClient, solved: str) -> None:
    assert f'href="/jobs/{solved}"' in working.get("/").text
    page = working.get(f"/jobs/{solved}").text
    assert 'class="mark pass"' in page
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
