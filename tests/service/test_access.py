"""Who may call what: tokens, names of the server, pages of other sites, headers."""

import base64
from pathlib import Path
from typing import Any

import pytest

from calibgraph.errors import CalibrationError, FileError
from calibgraph.service.app import create_app, require_safe
from calibgraph.service.request_guard import STRICT_HEADERS, add_token, load_tokens
from calibgraph.service.requests import Settings
from tests.service.conftest import Make, Problem, bearer


def test_every_operation_asks_who_calls(make_server: Make, tmp_path: Path) -> None:
    path = tmp_path / "tokens.txt"
    callers = {"none": {}, "wrong": bearer("wrong"), "right": bearer(add_token(path))}
    client = make_server(tokens=path)
    app: Any = client.app
    paths = app.openapi()["paths"] | dict.fromkeys(("/", "/openapi.json"), {"get": {}})
    operations = [(m.upper(), path) for path, item in paths.items() for m in item]
    assert len(operations) >= 13
    for method, place in operations:
        at = place.format(id="x", kind="solve", part="result", name="!")
        for caller, headers in callers.items():
            status = client.request(method, at, headers=headers).status_code
            if caller != "right" and place != "/healthz":
                assert status == 401, (method, at, caller)
            else:
                assert status in (200, 404, 415, 422), (method, at, caller)


def test_a_token_cannot_be_smuggled(make_server: Make, tmp_path: Path) -> None:
    path = tmp_path / "tokens.yaml"
    secret = add_token(path)
    client = make_server(tokens=path)
    assert secret not in path.read_text()
    assert path.stat().st_mode & 0o077 == 0

    def status(value: str) -> int:
        return client.get("/v1/jobs", headers={"Authorization": value}).status_code

    basic = base64.b64encode(f"any:{secret}".encode()).decode()
    assert [status(f"Bearer {secret}"), status(f"Basic {basic}")] == [200, 200]
    (digest,) = load_tokens(path)
    wrong = (f"Basic {secret[:-1]}", f"Bearer {secret[:-1]}", f"Bearer {secret}x", "Bearer", "",
             f"Bearer {digest}", "Basic", "Basic ////", "Basic " + "A" * 10_000)  # fmt: skip
    assert [status(value) for value in wrong] == [401] * len(wrong)
    assert client.get("/v1/jobs", params={"token": secret}).status_code == 401


def test_a_token_file_that_is_none_is_named(tmp_path: Path) -> None:
    path = tmp_path / "tokens.yaml"
    for text in ("00", "read " + "a" * 64, "g" * 64, "tokens: []"):
        path.write_text(text)
        with pytest.raises(FileError, match=r"tokens.yaml: line 1"):
            create_app(Settings(data=tmp_path / "data", tokens=path))


def test_a_page_of_another_site_can_not_call(make_server: Make, small: Problem) -> None:
    client = make_server()
    for origin in ("http://evil.example", "null", "http://[", "http://localhost.evil"):
        answer = client.post("/v1/jobs/solve", files=small.files, headers={"Origin": origin})
        assert answer.status_code == 403
    assert client.get("/healthz", headers={"Host": "evil.example"}).status_code == 400
    assert client.get("/healthz", headers={"Host": "["}).status_code == 400
    headers = {"Origin": "http://localhost"}
    assert client.post("/v1/jobs/solve", files=small.files, headers=headers).status_code == 202


def test_every_answer_has_strict_headers(make_server: Make) -> None:
    client = make_server()
    for path in ("/healthz", "/v1/jobs", "/nothing", "/", "/static/page.css", "/openapi.json"):
        headers = client.get(path).headers
        assert {name: headers[name] for name in STRICT_HEADERS} == STRICT_HEADERS


def test_without_tokens_only_loopback_is_listened_on() -> None:
    for host in ("127.0.0.1", "::1", "localhost"):
        require_safe(host, has_tokens=False)
    require_safe("0.0.0.0", has_tokens=True)
    for host in ("0.0.0.0", "192.168.1.4", "example.org", "::", ""):
        with pytest.raises(CalibrationError, match="--tokens"):
            require_safe(host, has_tokens=False)
