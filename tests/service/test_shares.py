"""Shares of tenants: what one asks for does not refuse another, nor let it wait for long."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import yaml
from starlette.testclient import TestClient

from calibgraph.service.app import create_app
from calibgraph.service.jobs import JobTable
from calibgraph.service.settings import Settings
from calibgraph.service.trackers import _MOST_WAITING
from tests.service.conftest import URL, Make, Problem, frames_as_lines, make_tokens

LINES = {"Content-Type": "application/x-ndjson"}
Headers = dict[str, str]


@pytest.fixture
def three(tmp_path: Path) -> list[Headers]:
    names = ("a", "b", "c")
    return make_tokens(tmp_path / "tokens.yaml", *((name, "submit") for name in names))


def table_of(client: TestClient) -> JobTable:
    table: JobTable = client.app.state.service.jobs  # type: ignore[attr-defined]
    return table


def submit(client: TestClient, small: Problem, headers: Headers) -> int:
    return client.post("/v1/solves", files=small.files, headers=headers).status_code


def test_a_full_queue_of_one_tenant_is_not_that_of_another(
    make_server: Make, small: Problem, tmp_path: Path, three: list[Headers]
) -> None:
    client = make_server(tokens=tmp_path / "tokens.yaml", most_queued=2)
    first, second, _ = three
    assert [submit(client, small, first) for _ in range(4)] == [202, 202, 429, 429]
    assert [submit(client, small, second) for _ in range(3)] == [202, 202, 429]


def test_tenants_take_turns(
    make_server: Make, small: Problem, tmp_path: Path, three: list[Headers]
) -> None:
    client = make_server(tokens=tmp_path / "tokens.yaml")
    for headers, count in zip(three, (4, 2, 1), strict=True):
        assert {submit(client, small, headers) for _ in range(count)} == {202}
    table, order = table_of(client), ""
    while (record := table.start_next()) is not None:
        order += record.tenant
        table.finish(record.id, "succeeded")
    assert order == "abcabaa"


def test_who_runs_least_is_next_and_no_one_has_all_processes(
    make_server: Make, small: Problem, tmp_path: Path, three: list[Headers]
) -> None:
    client = make_server(tokens=tmp_path / "tokens.yaml")
    first, second, _ = three
    assert {submit(client, small, first) for _ in range(4)} == {202}
    table = table_of(client)
    started = [table.start_next(2) for _ in range(3)]
    assert [record and record.tenant for record in started] == ["a", "a", None]
    assert submit(client, small, second) == 202
    late = table.start_next(2)
    assert late is not None
    assert late.tenant == "b"


@pytest.mark.parametrize(("given", "expected"), [(None, 2), (3, 3)])
def test_one_process_is_left_to_the_others(
    tmp_path: Path, three: list[Headers], given: int | None, expected: int
) -> None:
    tokens = tmp_path / "tokens.yaml"
    settings = Settings(data=tmp_path / "a", tokens=tokens, jobs_at_once=3, jobs_per_tenant=given)
    app = create_app(settings)
    assert app.state.service.settings.jobs_per_tenant == expected
    app.state.service.stop()
    alone = create_app(Settings(data=tmp_path / "b", jobs_at_once=3))
    assert alone.state.service.settings.jobs_per_tenant is None
    alone.state.service.stop()


@pytest.fixture(scope="module")
def tracking(tmp_path_factory: pytest.TempPathFactory) -> Any:
    folder = tmp_path_factory.mktemp("tracking")
    headers = make_tokens(folder / "tokens.yaml", ("a", "submit"), ("b", "submit"))
    settings = Settings(
        data=folder / "data", tokens=folder / "tokens.yaml", jobs_at_once=0, tracker_processes=1,
        free_bytes=0, most_trackers=8,
    )  # fmt: skip
    with TestClient(create_app(settings), URL) as client:
        yield client, headers


def begin(client: TestClient, small: Problem, headers: Headers) -> Any:
    return client.post("/v1/trackers", json={"rig": yaml.safe_load(small.rig)}, headers=headers)


def test_trackers_are_counted_per_tenant_however_fast_they_are_asked_for(
    tracking: Any, small: Problem
) -> None:
    client, (first, second) = tracking
    with ThreadPoolExecutor(16) as pool:
        answers = list(pool.map(lambda _: begin(client, small, first).status_code, range(20)))
    assert sorted(set(answers)) == [201, 429]
    assert len(client.get("/v1/trackers", headers=first).json()) == answers.count(201) <= 8
    assert begin(client, small, second).status_code == 201


@pytest.mark.slow
def test_frames_of_a_busy_tenant_do_not_hold_up_another(tracking: Any, small: Problem) -> None:
    client, (first, second) = tracking
    begin(client, small, first)  # unless it has as many as it may
    own = [f"/v1/trackers/{t['id']}" for t in client.get("/v1/trackers", headers=first).json()]
    lines = frames_as_lines(small.table)
    frames = [json.loads(line) for line in lines]
    at = begin(client, small, second).headers["location"]

    def send(where: str, i: int, headers: Headers) -> tuple[int, float]:
        frame = {**frames[i % len(frames)], "frame": i}
        start = time.monotonic()
        status = client.post(
            f"{where}/frames", content=json.dumps(frame), headers=headers | LINES
        ).status_code
        return status, time.monotonic() - start

    with ThreadPoolExecutor(_MOST_WAITING // 2) as pool:
        start = time.monotonic()
        busy = [pool.submit(send, own[i % len(own)], i, first) for i in range(_MOST_WAITING)]
        mine = [send(at, i, second) for i in range(3)]
        assert all(status == 200 for status, _ in mine)
        slowest = max(seconds for _, seconds in mine)
        assert {future.result()[0] for future in busy} <= {200, 429}
        whole = time.monotonic() - start
    assert slowest < whole / 2
