"""Trackers in their process: frames in, durable updates out."""

from __future__ import annotations

import io
import json
import shutil
import sys
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.child_process import Note, answer_requests, memory_limit
from calibgraph.errors import CalibrationError, CorrespondenceError
from calibgraph.files import checked_model, write_text
from calibgraph.service.tracker_request import ARROW, FramesTaken, Refusal, TrackerRequest
from calibgraph.yaml_text import parse_yaml

if TYPE_CHECKING:
    from calibgraph.tracking.durable import DurableCalibrator
    from calibgraph.tracking.history import History
    from calibgraph.tracking.streams import Item
    from calibgraph.tracking.update import Update

RIG, CONFIG, STATE, HISTORY, EVENTS = (
    "rig.yaml", "config.json", "state", "history.state", "events.jsonl",
)  # fmt: skip

_MOST_OPEN = 256
_SAVE_EVERY = 50  # updates: after a kill, the plot lacks fewer
_MOST_EVENTS = 200
_THREADS = 8  # most of an update's time it waits for the disk


@dataclass
class _Open:
    """A tracker that is in memory."""

    folder: Path
    calibrator: DurableCalibrator
    history: History
    unsaved: int = 0

    def close(self) -> None:
        self.save_history()
        self.calibrator.close()

    def save_history(self) -> None:
        if self.unsaved:
            self.history.save(self.folder / HISTORY)
            self.unsaved = 0


@dataclass
class _Trackers:
    """The trackers of this process; those used last are in memory."""

    held: OrderedDict[str, _Open] = field(default_factory=OrderedDict)
    locks: dict[str, threading.Lock] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def answer(self, request: TrackerRequest) -> Any:
        with self.lock:
            lock = self.locks.setdefault(request.folder, threading.Lock())
        with lock:
            try:
                return self._act(request)
            except MemoryError:
                self._drop(request.folder)
                return Refusal(413, "not enough memory; send fewer frames at once")
            except (CalibrationError, ValueError) as error:
                return Refusal(422, _without_path(str(error), request.folder))
            except OSError as error:  # a write failed: the state on disk is what counts
                self._drop(request.folder)
                return Refusal(507, f"the state cannot be written ({error.strerror or 'disk'})")

    def _act(self, request: TrackerRequest) -> Any:
        if request.action == "create":
            _create(request)
            return _state(self._opened(request.folder))
        if request.action == "frames":
            return _take_frames(self._opened(request.folder), request)
        if request.action == "state":
            return _state(self._opened(request.folder))
        if request.action == "plot":
            return _plot(self._opened(request.folder))
        if request.action == "remove":
            self._drop(request.folder)
            shutil.rmtree(request.folder, ignore_errors=True)
        return None

    def _opened(self, folder: str) -> _Open:
        with self.lock:
            tracker = self.held.get(folder)
            if tracker is not None:
                self.held.move_to_end(folder)
                return tracker
        tracker = _open(Path(folder))
        with self.lock:
            self.held[folder] = tracker
            oldest = next(iter(self.held)) if len(self.held) > _MOST_OPEN else None
            # One that is in use now is left for the next time.
            if oldest is not None and self.locks[oldest].acquire(blocking=False):
                self.held.pop(oldest).close()
                self.locks[oldest].release()
        return tracker

    def _drop(self, folder: str) -> None:
        with self.lock:
            tracker = self.held.pop(folder, None)
        if tracker is not None:
            tracker.calibrator.abandon()

    def close(self) -> None:
        for tracker in self.held.values():
            tracker.close()
        self.held.clear()


def _without_path(text: str, folder: str) -> str:
    return text.replace(f"{folder}/", "").replace(folder, "the tracker")


def _create(request: TrackerRequest) -> None:
    """Check the rig and the settings, and write them down."""
    from calibgraph.files import read_text
    from calibgraph.model.config import config_from
    from calibgraph.model.rig import Rig
    from calibgraph.tracking.offsets import require_offset_alone

    folder = Path(request.folder)
    text = request.body.decode("utf-8")
    checked_model(Rig, parse_yaml(text, RIG), RIG)
    require_offset_alone(config_from(json.loads(request.config), "config"))
    write_text(folder / CONFIG, request.config)
    write_text(folder / RIG, text)
    read_text(folder / RIG)


def _open(folder: Path) -> _Open:
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.config import config_from
    from calibgraph.tracking.durable import DurableCalibrator
    from calibgraph.tracking.history import History

    config = config_from(json.loads((folder / CONFIG).read_text("utf-8")), "config")
    calibrator = DurableCalibrator(folder / STATE, load_rig(folder / RIG), config)
    tracker = _Open(folder, calibrator, History.load(folder / HISTORY))
    known = {json.dumps(event) for event in _events(folder)}
    for update in calibrator.repeated:  # the process ended before they may have been noted
        _note_events(folder, update, known)
    return tracker


def _take_frames(tracker: _Open, request: TrackerRequest) -> FramesTaken:
    """Take in frames; one write brings them to disk before their updates are answered."""
    from calibgraph.tracking.update import json_line

    refused: list[str] = []
    with tracker.calibrator.in_one_write():
        updates, known = _take(tracker.calibrator, _items(request, refused), refused)
    for update in updates:
        tracker.history.add(update)
        tracker.unsaved += 1
        _note_events(tracker.folder, update, set())
    if tracker.unsaved >= _SAVE_EVERY:
        tracker.save_history()
    lines = ", ".join(map(json_line, updates))
    rest = json.dumps({"known": known, "refused": refused}).removeprefix("{")
    return FramesTaken(len(updates), f'{{"updates": [{lines}], {rest}')


def _take(
    calibrator: DurableCalibrator, items: Iterable[Item], refused: list[str]
) -> tuple[list[Update], int]:
    """The updates of frames, and how many were known; what is refused is added to a list."""
    from calibgraph.tracking.streams import Refused

    updates: list[Update] = []
    known, last = 0, calibrator.tracker.frame
    for item in items:
        if isinstance(item, Refused):
            refused.append(item.message)
        elif last is not None and item.frame <= last:
            known += 1
        else:
            try:
                updates.append(calibrator.update(item.table, frame=item.frame))
                last = item.frame
            except CorrespondenceError as error:
                refused.append(str(error))
    return updates, known


def _items(request: TrackerRequest, refused: list[str]) -> Iterator[Item]:
    """The frames of a body; a stream that breaks off is refused after its whole frames."""
    from calibgraph.errors import FileError
    from calibgraph.tracking.stream_lines import frames_of_lines
    from calibgraph.tracking.stream_tables import frames_of_batches

    try:
        if request.content_type == ARROW:
            yield from frames_of_batches(io.BytesIO(request.body), "frames")
        else:
            yield from frames_of_lines([request.body], "frames")
    except FileError as error:
        refused.append(str(error))


def _note_events(folder: Path, update: Update, known: set[str]) -> None:
    """Add an update's events to the list."""
    from calibgraph.tracking.update import json_line

    if not update.events:
        return
    lines = [json.dumps(event) for event in json.loads(json_line(update))["events"]]
    with (folder / EVENTS).open("a", encoding="utf-8") as file:
        file.writelines(f"{line}\n" for line in lines if line not in known)


def _events(folder: Path) -> list[dict[str, Any]]:
    path = folder / EVENTS
    if not path.exists():
        return []
    lines = path.read_text("utf-8", errors="replace").splitlines()[-_MOST_EVENTS:]
    return [event for line in lines if isinstance(event := _json(line), dict)]


def _json(line: str) -> object:
    try:
        return json.loads(line)
    except ValueError:  # the process ended while it was written
        return None


def _state(tracker: _Open) -> dict[str, Any]:
    """The last estimate, as ``--json`` prints results, and the last events."""
    from calibgraph.report.as_json import finite, result_summary

    summary = result_summary(tracker.calibrator.tracker.calibration(), [])
    return {
        "frame": tracker.calibrator.tracker.frame,
        "verdict": summary["verdict"],
        "cannot_tell": summary["cannot_tell"],
        "reasons": summary["reasons"],
        "summary": finite(summary["summary"]),
        "cameras": finite(summary["cameras"]),
        "events": _events(tracker.folder),
    }


def _plot(tracker: _Open) -> bytes:
    """The extrinsics against time, PNG."""
    held = io.BytesIO()
    tracker.history.figure().savefig(held, format="png")
    return held.getvalue()


def main() -> None:
    """The process: lists of requests to trackers, each list at once."""
    from calibgraph.tracking.preload import warm_up_tracker

    warm_up_tracker()
    trackers, pool = _Trackers(), ThreadPoolExecutor(_THREADS)

    def answer(requests: list[TrackerRequest], note: Note) -> None:
        """Note each answer, with its place in the list, as soon as it is there."""
        asked = {pool.submit(trackers.answer, request): i for i, request in enumerate(requests)}
        for future in as_completed(asked):
            note((asked[future], future.result()))
        if any(request.action == "close all" for request in requests):
            trackers.close()

    with memory_limit(int(sys.argv[2])):
        answer_requests(answer)


if __name__ == "__main__":
    main()
