"""Trackers over HTTP: frames once, as `track` prints them, on disk when acknowledged."""

import io
from collections.abc import Callable, Iterator
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from starlette.testclient import TestClient

from tests.service.conftest import Problem, service_folder
from tests.service.serving import frames_as_lines


@pytest.fixture
def at(working: TestClient, small: Problem) -> Iterator[str]:
    """A tracker of the small problem's rig."""
    answer = working.put("/v1/trackers/car-1", content=small.rig)
    assert answer.status_code == 200, answer.text
    yield "/v1/trackers/car-1"
    working.delete("/v1/trackers/car-1")


def send(client: TestClient, at: str, *lines: bytes) -> Any:
    return client.post(at, content=b"".join(lines)).json()


def test_frames_are_taken_in_once(working: TestClient, small: Problem, at: str) -> None:
    lines = frames_as_lines(small.table)
    first = send(working, at, *lines[:2])
    assert [update["frame"] for update in first["updates"]] == [0, 1]
    again = send(working, at, *lines[:3])
    assert (again["known"], [update["frame"] for update in again["updates"]]) == (2, [2])


def arrow_stream(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return sink.getvalue()


def test_frames_of_an_arrow_stream_give_the_updates_of_lines(
    working: TestClient, small: Problem, at: str
) -> None:
    """Of columns out of the order of their frames, too."""
    columns = ["camera", "frame", "u_px", "v_px", "x_m", "y_m", "z_m"]
    table = pq.read_table(io.BytesIO(small.table), columns=columns).replace_schema_metadata(None)
    frames = len(table["frame"].unique())
    body = arrow_stream(table.sort_by([("frame", "descending")]))
    assert working.put("/v1/trackers/arrow", content=small.rig).status_code == 200
    found = send(working, "/v1/trackers/arrow", body)
    assert found == send(working, at, *frames_as_lines(small.table))
    assert (found["refused"], found["known"], len(found["updates"])) == ([], 0, frames)
    assert send(working, "/v1/trackers/arrow", body)["known"] == frames
    working.delete("/v1/trackers/arrow")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda table: arrow_stream(table)[:-700], "not a whole Arrow IPC stream"),
        (lambda table: b"\xff\xff\xff\xff" + 100 * b"a", "not a whole Arrow IPC stream"),
        (lambda table: arrow_stream(table.drop_columns(["u_px"])), "u_px"),
        (lambda table: arrow_stream(table.set_column(1, "frame", table["camera"])), "frame"),
    ],
)
def test_an_arrow_stream_that_is_damaged_is_refused_in_words(
    working: TestClient, small: Problem, at: str, damage: Callable[[pa.Table], bytes], words: str
) -> None:
    answer = working.post(at, content=damage(pq.read_table(io.BytesIO(small.table))))
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert working.get(at).json()["frame"] is None


def test_what_cannot_be_read_is_refused_in_words(working: TestClient, at: str) -> None:
    answer = send(working, at, b'{"frame": 1, "cameras": {"nobody": {}}}\n')
    assert answer["updates"] == []
    assert "nobody" in answer["refused"][0]


def test_a_request_with_a_motion_of_no_vehicle_is_refused_whole(
    working: TestClient, small: Problem, at: str
) -> None:
    lines = [line.rstrip() for line in frames_as_lines(small.table)[:3]]
    with_motion = [
        line[:-1] + b', "twist_per_s": [%d, 0.0, 0.0, 0.0, 0.0, 0.1]}\n' % ahead
        for line, ahead in zip(lines, (1, 8, 9), strict=True)
    ]
    answer = working.post(at, content=b"".join(with_motion))
    assert answer.status_code == 422
    assert answer.json()["detail"].endswith("; none of these frames was taken in")
    assert len(send(working, at, *(line + b"\n" for line in lines))["updates"]) == 3


def test_a_state_survives_its_process(working: TestClient, small: Problem, at: str) -> None:
    send(working, at, *frames_as_lines(small.table)[:4])
    before = working.get(at).json()
    app: Any = working.app
    for child, _ in app.state.service.trackers._hosts:
        child.kill()
    working.get(at)  # it may meet the end of the process
    assert working.get(at).json() == before
    assert before["frame"] == 3


@pytest.mark.parametrize(
    ("rig", "config", "detail"),
    [
        (b"cameras: 7", "{}", "rig.yaml"),
        (b"\xff\xfe", "{}", "rig.yaml"),
        (None, '{"evil": 1}', "evil"),
        (None, "{", "Expecting"),
        (None, '{"estimate": ["focal_length"]}', ""),
    ],
)
def test_a_tracker_that_cannot_be_made_leaves_nothing(
    working: TestClient, small: Problem, rig: bytes | None, config: str, detail: str
) -> None:
    at = "/v1/trackers/broken"
    answer = working.put(at, content=rig or small.rig, params={"config": config})
    assert answer.status_code == 422 and detail in answer.json()["detail"], answer.text
    assert str(service_folder(working)) not in answer.text
    assert working.get(at).status_code == 404
    assert not (service_folder(working) / "trackers" / "broken").exists()


def test_names_of_trackers_are_no_paths(working: TestClient, small: Problem) -> None:
    for name in ("..%2Fcar", "%2e%2e", ".hidden", "a%00b", "x" * 65, "a%0ab"):
        assert working.put(f"/v1/trackers/{name}", content=small.rig).status_code in (404, 405, 422)


def test_a_tracker_is_made_once_and_removed(working: TestClient, small: Problem, at: str) -> None:
    assert working.put(at, content=small.rig).status_code == 409
    assert working.delete(at).status_code == 200
    assert working.get(at).status_code == working.delete(at).status_code == 404
