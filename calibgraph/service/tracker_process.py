"""Trackers in their process: frames in, durable updates out."""

from __future__ import annotations

import gc
import io
import json
import shutil
import sys
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calibgraph.child_process import Note, answer_requests, memory_limit
from calibgraph.errors import CalibrationError
from calibgraph.files import checked_model, write_text
from calibgraph.service.open_tracker import HISTORY, OpenTracker, take_frames
from calibgraph.service.tracker_request import Refusal, TrackerRequest
from calibgraph.yaml_text import parse_yaml

RIG, CONFIG, STATE = "rig.yaml", "config.json", "state"

_MOST_OPEN = 256
_THREADS = 8  # most of an update's time it waits for the disk
_COLLECT_AFTER = 10_000  # new objects: what an update makes is freed without the collector


@dataclass
class _Trackers:
    """The trackers of this process; those used last are in memory."""

    held: OrderedDict[str, OpenTracker] = field(default_factory=OrderedDict)
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
                if request.action == "frames":  # it may be in the middle of an update
                    self._drop(request.folder)
                return Refusal(422, _without_path(str(error), request.folder))
            except OSError as error:  # a write failed: the state on disk is what counts
                self._drop(request.folder)
                return Refusal(507, f"the state cannot be written ({error.strerror or 'disk'})")

    def _act(self, request: TrackerRequest) -> Any:
        if request.action == "create":
            _create(request)
            return _state(self._opened(request.folder))
        if request.action == "frames":
            return take_frames(self._opened(request.folder), request)
        if request.action == "state":
            return _state(self._opened(request.folder))
        if request.action == "plot":
            return _plot(self._opened(request.folder))
        if request.action == "remove":
            self._drop(request.folder)
            shutil.rmtree(request.folder, ignore_errors=True)
        return None

    def _opened(self, folder: str) -> OpenTracker:
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
            tracker.abandon()

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


def _open(folder: Path) -> OpenTracker:
    from calibgraph.io.rigs import load_rig
    from calibgraph.model.config import config_from
    from calibgraph.tracking.durable import DurableCalibrator
    from calibgraph.tracking.history import History

    config = config_from(json.loads((folder / CONFIG).read_text("utf-8")), "config")
    calibrator = DurableCalibrator(folder / STATE, load_rig(folder / RIG), config)
    tracker = OpenTracker(folder, calibrator, History.load(folder / HISTORY))
    known = {json.dumps(event) for event in tracker.events()}
    for update in calibrator.repeated:  # the process ended before they may have been noted
        tracker.note_events(update, known)
    return tracker


def _state(tracker: OpenTracker) -> dict[str, Any]:
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
        "events": tracker.events(),
    }


def _plot(tracker: OpenTracker) -> bytes:
    """The extrinsics against time, PNG."""
    held = io.BytesIO()
    tracker.history.figure().savefig(held, format="png")
    return held.getvalue()


def main() -> None:
    """The process: lists of requests to trackers, each list at once."""
    from calibgraph.tracking.preload import warm_up_tracker

    warm_up_tracker()
    gc.freeze()  # what is loaded by now stays: each full collection would visit it
    gc.set_threshold(_COLLECT_AFTER)
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
