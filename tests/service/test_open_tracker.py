"""Frames of long requests: a write for some of them, and what an error or a kill leaves."""

from __future__ import annotations

import json
import shutil
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibgraph import Correspondences, DurableCalibrator, perturb
from calibgraph.service import open_tracker
from calibgraph.service.tracker_process import STATE, _Trackers
from calibgraph.service.tracker_request import FramesTaken, Refusal, TrackerRequest
from calibgraph.tracking import durable, stream_lines
from calibgraph.tracking.history import History
from calibgraph.tracking.state_database import StateDatabase
from calibgraph.tracking.stream_tables import StreamFrame
from tests.tracking.drives import as_lines, drive, expected_lines, pair_of

GUESS = perturb(pair_of(), rotation_deg=1, translation_m=0.1, seed=1)


@pytest.fixture(scope="module")
def tables() -> list[Correspondences]:
    return drive(pair_of())


@pytest.fixture
def trackers(tmp_path: Path) -> _Trackers:
    """With one tracker, in the folder ``car``."""
    held = _Trackers()
    (tmp_path / "car").mkdir()
    rig = json.dumps(GUESS.model_dump(mode="json")).encode()
    created = held.answer(TrackerRequest("create", str(tmp_path / "car"), rig))
    assert not isinstance(created, Refusal), created
    return held


def send(trackers: _Trackers, folder: Path, tables: list[Correspondences]) -> Any:
    return trackers.answer(TrackerRequest("frames", str(folder), as_lines(tables)))


def updates_in(answer: Any) -> list[dict[str, Any]]:
    assert isinstance(answer, FramesTaken), answer
    found: list[dict[str, Any]] = json.loads(answer.body)["updates"]
    return found


@pytest.fixture
def writes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many updates each write had."""
    append, sizes = StateDatabase.append, list[int]()

    def counted(database: StateDatabase, *records: bytes) -> None:
        append(database, *records)
        sizes.append(len(records))

    monkeypatch.setattr(StateDatabase, "append", counted)
    return sizes


@pytest.mark.parametrize(
    ("frames", "seconds", "sizes"),
    [(50, 1e9, [7]), (5, 1e9, [5, 1, 1]), (7, 1e9, [6, 1]), (50, 0.0, [6, 1])],
)
def test_a_write_ends_after_some_frames_or_some_time(  # noqa: PLR0913
    trackers: _Trackers, tables: list[Correspondences], writes: list[int],
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    frames: int, seconds: float, sizes: list[int],
) -> None:  # fmt: skip
    monkeypatch.setattr(open_tracker, "_WRITE_FRAMES", frames)
    monkeypatch.setattr(open_tracker, "_WRITE_S", seconds)
    found = updates_in(send(trackers, tmp_path / "car", tables))
    lines = expected_lines(GUESS, tables, together=min(frames, 10))
    assert found == [json.loads(line) for line in lines]
    assert writes == sizes  # of inputs: the first frames one by one, then those of an epoch


def test_a_kill_in_a_long_request_leaves_its_earlier_writes_and_a_short_repetition(
    trackers: _Trackers,
    tables: list[Correspondences],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Writes of two frames, and a snapshot that is due after two: 12 are on disk at the 14th."""
    monkeypatch.setattr(open_tracker, "_WRITE_FRAMES", 2)
    monkeypatch.setattr(durable, "_SNAPSHOT_EVERY", 2)
    update, copy = DurableCalibrator.update_together, tmp_path / "killed"

    def copied(calibrator: DurableCalibrator, frames: list[StreamFrame]) -> Any:
        if frames[-1].frame == tables[-1].frame[0]:
            shutil.copytree(tmp_path / "car" / STATE, copy)
        return update(calibrator, frames)

    with monkeypatch.context() as patch:
        patch.setattr(DurableCalibrator, "update_together", copied)
        assert len(updates_in(send(trackers, tmp_path / "car", tables))) == len(tables)
    with DurableCalibrator(copy, GUESS) as resumed:
        assert resumed.tracker.frame == tables[11].frame[0]
        assert len(resumed.repeated) <= 2 + 2 * 2


def test_a_request_with_a_motion_of_no_vehicle_is_refused_whole(
    trackers: _Trackers, tmp_path: Path, tables: list[Correspondences]
) -> None:
    lines = [json.loads(line) for line in as_lines(tables[:3]).splitlines()]
    for line, ahead in zip(lines, (1.0, 8.0, 9.0), strict=True):  # its columns are swapped
        line["twist_per_s"] = [ahead, 0.0, 0.0, 0.0, 0.0, 0.1]
    body = "\n".join(map(json.dumps, lines)).encode()
    answer = trackers.answer(TrackerRequest("frames", str(tmp_path / "car"), body))
    assert isinstance(answer, Refusal) and answer.status == 422
    assert answer.detail.startswith("frames, line 2: row 0 (camera 'left', frame 1): twist must be")
    assert answer.detail.endswith("; none of these frames was taken in")
    assert len(updates_in(send(trackers, tmp_path / "car", tables[:3]))) == 3


@pytest.mark.parametrize("twist", [None, [0.0, 0.0, 0.1, 8.0, 0.0, 0.0]])
def test_few_frames_of_a_long_request_are_in_memory_beside_its_body(
    trackers: _Trackers, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, twist: list[float] | None
) -> None:
    """Also where all of it is looked through for its motion before."""
    read, held, most = stream_lines.frames_of_lines, list[weakref.ref[Any]](), 0

    def watched(chunks: Any, where: str) -> Any:
        nonlocal most
        for item in read(chunks, where):
            held.append(weakref.ref(item))
            most = max(most, sum(one() is not None for one in held))
            yield item
            del item

    monkeypatch.setattr(stream_lines, "frames_of_lines", watched)
    lines = [json.loads(line) for line in as_lines(drive(pair_of(), 40)).splitlines()]
    more = {} if twist is None else {"twist_per_s": twist}
    body = "\n".join(json.dumps({**line, **more}) for line in lines).encode()
    answer = trackers.answer(TrackerRequest("frames", str(tmp_path / "car"), body))
    assert len(updates_in(answer)) == len(lines)
    assert most <= 2 * open_tracker._TOGETHER  # a group, and the next one


def test_an_error_keeps_the_frames_before_it_with_plot_and_events(
    trackers: _Trackers,
    tables: list[Correspondences],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    car, update = tmp_path / "car", DurableCalibrator.update

    def broken(calibrator: DurableCalibrator, table: Correspondences, **options: Any) -> Any:
        if options["frame"] == tables[9].frame[0]:
            raise np.linalg.LinAlgError("singular matrix")
        return update(calibrator, table, **options)

    with monkeypatch.context() as patch:
        patch.setattr(DurableCalibrator, "update", broken)
        patch.setattr(DurableCalibrator, "update_together", lambda *_: [])
        answer = send(trackers, car, tables)
    assert answer == Refusal(422, "singular matrix")
    lines = expected_lines(GUESS, tables)
    events = [event for line in lines[:9] for event in json.loads(line)["events"]]
    assert [event["kind"] for event in events] == ["started", "started"]
    assert trackers.answer(TrackerRequest("state", str(car)))["events"] == events
    assert len(History.load(car / open_tracker.HISTORY)) == 9
    answer = send(trackers, car, tables)
    assert json.loads(answer.body)["known"] == 9
    lines = expected_lines(GUESS, *([table] for table in tables[:10]), tables[10:], together=10)
    assert updates_in(answer) == [json.loads(line) for line in lines[9:]]
    trackers.close()
    assert len(History.load(car / open_tracker.HISTORY)) == len(tables)


def test_frames_of_a_write_that_fails_are_not_noted(
    trackers: _Trackers,
    tables: list[Correspondences],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The second write fails: events of its frames would stand twice when these come again."""
    monkeypatch.setattr(open_tracker, "_WRITE_FRAMES", 2)
    append, car = StateDatabase.append, tmp_path / "car"

    def full(database: StateDatabase, *records: bytes) -> None:
        if database.number == 2:
            raise OSError(28, "No space left on device")
        append(database, *records)

    with monkeypatch.context() as patch:
        patch.setattr(StateDatabase, "append", full)
        assert send(trackers, car, tables).status == 507
    assert len(History.load(car / open_tracker.HISTORY)) == 2
    assert len(updates_in(send(trackers, car, tables))) == len(tables) - 2
    trackers.close()
    assert len(History.load(car / open_tracker.HISTORY)) == len(tables)
