"""Trackers over HTTP: frames once, on disk when acknowledged, state over restarts."""

from __future__ import annotations

from typing import Any

import yaml
from starlette.testclient import TestClient

from tests.service.conftest import Make, Problem, frames_as_lines

LINES = {"Content-Type": "application/x-ndjson"}


def begin(client: TestClient, small: Problem) -> str:
    answer = client.post("/v1/trackers", json={"rig": yaml.safe_load(small.rig), "name": "car-1"})
    assert answer.status_code == 201, answer.text
    return str(answer.headers["location"])


def send(client: TestClient, at: str, *lines: bytes) -> Any:
    return client.post(f"{at}/frames", content=b"".join(lines), headers=LINES).json()


def test_frames_are_taken_in_once(working: TestClient, small: Problem) -> None:
    at, lines = begin(working, small), frames_as_lines(small.table)
    first = send(working, at, *lines[:2])
    assert [update["frame"] for update in first["updates"]] == [0, 1]
    again = send(working, at, *lines[:3])
    assert (again["known"], [update["frame"] for update in again["updates"]]) == (2, [2])


def test_what_cannot_be_read_is_refused_in_words(working: TestClient, small: Problem) -> None:
    answer = send(working, begin(working, small), b'{"frame": 1, "cameras": {"nobody": {}}}\n')
    assert answer["updates"] == []
    assert "nobody" in answer["refused"][0]


def test_a_state_survives_its_process(working: TestClient, small: Problem) -> None:
    at, lines = begin(working, small), frames_as_lines(small.table)
    send(working, at, *lines[:4])
    before = working.get(f"{at}/state").json()
    app: Any = working.app
    for host in app.state.service.trackers._hosts:
        host._child.kill()
    working.get(f"{at}/state")  # it may meet the end of the process
    assert working.get(f"{at}/state").json() == before
    assert before["frame"] == 3


def test_a_drift_is_drawn_and_shown(working: TestClient, small: Problem) -> None:
    at, lines = begin(working, small), frames_as_lines(small.table)
    send(working, at, *lines[:4])
    assert working.get(f"{at}/drift.png").content.startswith(b"\x89PNG")
    page = working.get(at.removeprefix("/v1")).text
    assert f"{at}/drift.png" in page
    assert "car-1" in page


def test_a_removed_tracker_is_gone(working: TestClient, small: Problem) -> None:
    at = begin(working, small)
    assert working.delete(at).status_code == 204
    assert working.get(f"{at}/state").status_code == 404


def test_a_server_without_trackers_refuses(make_server: Make, small: Problem) -> None:
    answer = make_server().post("/v1/trackers", json={"rig": yaml.safe_load(small.rig)})
    assert answer.status_code == 503
