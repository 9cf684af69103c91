"""Who may call what: tokens, tenants, names of the server, headers."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from calibgraph.errors import CalibrationError, FileError
from calibgraph.service.access import COOKIE, add_token, load_tokens
from calibgraph.service.places import open_roots
from calibgraph.service.request_guard import STRICT_HEADERS
from calibgraph.service.serve import Address, require_certificate, require_safe
from tests.service.conftest import Make, Problem, make_tokens

OPEN = {("GET", "/healthz"), ("GET", "/readyz")}
"""Operations that need no token."""
Callers = dict[str, dict[str, str]]
Guarded = tuple[TestClient, Callers, str]


@pytest.fixture
def guarded(make_server: Make, tmp_path: Path, small: Problem) -> Guarded:
    """A server with a job of tenant ``ours``; the headers of each caller; the job's id."""
    path = tmp_path / "tokens.yaml"
    names = (("ours", "read"), ("ours", "submit"), ("theirs", "submit"), ("any", "admin"))
    read, submit, other, admin = make_tokens(path, *names)
    client = make_server(tokens=path)
    callers = {
        "none": {}, "wrong": {"Authorization": "Bearer wrong"}, "read": read, "submit": submit,
        "other tenant": other, "admin": admin,
    }  # fmt: skip
    id = client.post("/v1/solves", files=small.files, headers=submit).json()["id"]
    return client, callers, id


def expected(method: str, path: str, caller: str) -> set[int]:
    """The statuses that the answer may have, by the rules of docs/service.md."""
    if (method, path) in OPEN:
        return {200}
    if caller in ("none", "wrong"):
        return {401}
    needs_admin, changes = path == "/metrics", method != "GET"
    if (needs_admin and caller != "admin") or (changes and caller == "read"):
        return {403}
    if "{id}" in path:
        is_hidden = caller == "other tenant" or "trackers" in path
        return {404} if is_hidden else {200, 409}
    return {200} if method == "GET" else {415, 422}


def test_every_operation_asks_who_calls(guarded: Guarded) -> None:
    client, callers, id = guarded
    app: Any = client.app
    paths = app.openapi()["paths"]
    operations = [(m.upper(), path) for path, item in paths.items() for m in item]
    assert len(operations) >= 19
    wrong = []
    for (method, path), caller in itertools.product(operations, callers):
        place = path.replace("{id}", id).replace("{format}", "urdf")
        if place.endswith("/events") and caller in ("read", "submit", "admin"):
            continue  # it does not end before the job
        status = client.request(method, place, headers=callers[caller]).status_code
        if status not in expected(method, path, caller):
            wrong.append((method, path, caller, status))
    assert wrong == []


def test_a_tenant_sees_its_own_jobs_alone(guarded: Guarded) -> None:
    client, callers, id = guarded
    seen = {
        name: [job["id"] for job in client.get("/v1/jobs", headers=callers[name]).json()["jobs"]]
        for name in ("read", "submit", "other tenant", "admin")
    }
    assert seen == {"read": [id], "submit": [id], "other tenant": [], "admin": [id]}


def test_keys_of_tenants_do_not_meet(guarded: Guarded, small: Problem) -> None:
    client, callers, _ = guarded
    ids = {
        client.post(
            "/v1/solves", files=small.files, headers={**callers[name], "Idempotency-Key": "one"}
        ).json()["id"]
        for name in ("submit", "other tenant")
    }
    assert len(ids) == 2


def test_a_token_file_holds_hashes_alone(tmp_path: Path) -> None:
    path = tmp_path / "tokens.yaml"
    secret = add_token(path, "ours", "read")
    assert secret not in path.read_text()
    assert path.stat().st_mode & 0o077 == 0
    assert len(load_tokens(path)) == 1


def test_a_page_of_another_site_can_not_call(make_server: Make, small: Problem) -> None:
    client = make_server()
    for origin in ("http://evil.example", "null"):
        answer = client.post("/v1/solves", files=small.files, headers={"Origin": origin})
        assert answer.status_code == 403
    assert client.get("/healthz", headers={"Host": "evil.example"}).status_code == 400


def test_every_answer_has_strict_headers(make_server: Make) -> None:
    client = make_server()
    for path in ("/healthz", "/v1/jobs", "/nothing", "/", "/docs", "/static/page.css"):
        headers = client.get(path).headers
        assert {name: headers[name] for name in STRICT_HEADERS} == STRICT_HEADERS


def test_without_tokens_only_loopback_is_listened_on() -> None:
    for host in ("127.0.0.1", "::1", "localhost"):
        require_safe(Address(host), has_tokens=False)
    require_safe(Address("0.0.0.0"), has_tokens=True)
    for host in ("0.0.0.0", "192.168.1.4", "example.org"):
        with pytest.raises(CalibrationError, match="--tokens"):
            require_safe(Address(host), has_tokens=False)


def test_files_that_are_no_certificate_are_named(tmp_path: Path) -> None:
    missing, garbage = tmp_path / "none.pem", tmp_path / "garbage.pem"
    garbage.write_text("no certificate")
    with pytest.raises(FileError, match="none.pem: no such file"):
        require_certificate(Address("127.0.0.1", 8000, missing, missing))
    with pytest.raises(FileError, match="garbage.pem: is no PEM certificate"):
        require_certificate(Address("127.0.0.1", 8000, garbage, garbage))


def test_an_empty_root_is_not_the_working_folder() -> None:
    with pytest.raises(FileError, match="--root: is empty"):
        open_roots(("",))


@pytest.mark.parametrize(
    ("api_docs", "unknown", "known"),
    [
        ("token", (401, 303), (200, 200)),
        ("open", (200, 200), (200, 200)),
        ("off", (404, 404), (404, 404)),
    ],
)
def test_the_operator_chooses_who_reads_the_description_of_the_api(
    make_server: Make,
    tmp_path: Path,
    api_docs: str,
    unknown: tuple[int, int],
    known: tuple[int, int],
) -> None:
    path = tmp_path / "tokens.yaml"
    (token,) = make_tokens(path, ("ours", "read"))
    client = make_server(tokens=path, api_docs=api_docs)
    secret = token["Authorization"].removeprefix("Bearer ")

    def statuses(headers: dict[str, str]) -> tuple[int, int]:
        cookie = {"Cookie": f"{COOKIE}={secret}"} if headers else {}
        return (
            client.get("/openapi.json", headers=headers).status_code,
            client.get("/docs", headers=cookie).status_code,
        )

    assert (statuses({}), statuses(token)) == (unknown, known)
    assert make_server("alone").get("/openapi.json").status_code == 200
