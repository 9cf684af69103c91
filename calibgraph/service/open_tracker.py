"""A tracker that is in memory, and the frames that it takes in."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.service.tracker_request import FramesTaken, Refusal, TrackerRequest

if TYPE_CHECKING:
    from calibgraph.tracking.durable import DurableCalibrator
    from calibgraph.tracking.history import History
    from calibgraph.tracking.streams import Refused, StreamFrame
    from calibgraph.tracking.update import Update

HISTORY = "history.state"
_EVENTS = "events.jsonl"
_SAVE_EVERY = 50  # updates: after a kill, the plot lacks fewer, and those of a write
_MOST_EVENTS = 200
_TOGETHER = 10  # frames that are read before they are taken in: an epoch's
_WRITE_FRAMES, _WRITE_S = 50, 1.0  # of one write: a kill costs no more, and snapshots follow


@dataclass
class OpenTracker:
    """A tracker with its plot and the list of its events.

    Attributes:
        folder: where all of it is kept.
        calibrator: the tracker.
        history: of its updates that are on disk, for the plot.
        unsaved: how many of these the file of the history lacks.
    """

    folder: Path
    calibrator: DurableCalibrator
    history: History
    unsaved: int = 0

    def close(self) -> None:
        """Write all of it, and release the folder."""
        self.save_history()
        self.calibrator.close()

    def abandon(self) -> None:
        """Release the folder with the state that is on disk, as after an error."""
        self.calibrator.abandon()
        with suppress(OSError):  # it is for the eye alone
            self.save_history()

    def save_history(self) -> None:
        """Write the history, if it has changed."""
        if self.unsaved:
            self.history.save(self.folder / HISTORY)
            self.unsaved = 0

    def note(self, updates: Sequence[Update]) -> None:
        """Add updates that are on disk to the plot and to the list of events."""
        for update in updates:
            self.history.add(update)
            self.unsaved += 1
            self.note_events(update, set())
        if self.unsaved >= _SAVE_EVERY:
            self.save_history()

    def note_events(self, update: Update, known: set[str]) -> None:
        """Add an update's events to the list, but for those known, as JSON."""
        from calibgraph.tracking.update import json_line

        if not update.events:
            return
        lines = [json.dumps(event) for event in json.loads(json_line(update))["events"]]
        with (self.folder / _EVENTS).open("a", encoding="utf-8") as file:
            file.writelines(f"{line}\n" for line in lines if line not in known)

    def events(self) -> list[dict[str, Any]]:
        """The last events, the newest at the end."""
        path = self.folder / _EVENTS
        if not path.exists():
            return []
        lines = path.read_text("utf-8", errors="replace").splitlines()[-_MOST_EVENTS:]
        return [event for line in lines if isinstance(event := _json(line), dict)]


def _json(line: str) -> object:
    try:
        return json.loads(line)
    except ValueError:  # the process ended while it was written
        return None


@dataclass
class _Taken:
    """What became of the frames of a request."""

    updates: list[Update] = field(default_factory=list)
    known: int = 0
    refused: list[str] = field(default_factory=list)


def take_frames(tracker: OpenTracker, request: TrackerRequest) -> FramesTaken | Refusal:
    """Take in the frames of a request; they are on disk before their updates are answered.

    Whatever ends a long request, the frames of its earlier writes are known then. One with a motion
    that no vehicle has is refused whole: its slower frames look right, and are not.

    Raises:
        OSError: if they cannot be written; then abandon the tracker, and open it anew.
    """
    from calibgraph.tracking.frame_group import in_groups
    from calibgraph.tracking.stream_lines import frames_of_lines
    from calibgraph.tracking.update import json_lines

    wrong = _first_of_no_vehicle(request)
    if wrong is not None:
        return Refusal(422, f"{wrong.message}; none of these frames was taken in")
    taken = _Taken()
    groups = in_groups(frames_of_lines([request.body], "frames"), min(_TOGETHER, _WRITE_FRAMES))
    while _take_by_one_write(tracker, groups, taken):
        pass
    lines = ", ".join(json_lines(taken.updates))
    rest = json.dumps({"known": taken.known, "refused": taken.refused}).removeprefix("{")
    return FramesTaken(len(taken.updates), f'{{"updates": [{lines}], {rest}')


def _first_of_no_vehicle(request: TrackerRequest) -> Refused | None:
    """The first frame with a motion of no vehicle; a body that states motions is read twice."""
    from calibgraph.tracking.stream_lines import frames_of_lines
    from calibgraph.tracking.streams import Refused

    if b"twist_per_s" not in request.body:
        return None
    items = frames_of_lines([request.body], "frames")
    found = (item for item in items if isinstance(item, Refused))
    return next((item for item in found if item.by_motion), None)


def _take_by_one_write(
    tracker: OpenTracker, groups: Iterator[list[StreamFrame] | Refused], taken: _Taken
) -> bool:
    """Take in some frames, and note those that are on disk; whether there may be more."""
    before, end = len(taken.updates), time.monotonic() + _WRITE_S
    try:
        with tracker.calibrator.in_one_write():
            for group in groups:
                _take(tracker.calibrator, group, taken)
                if len(taken.updates) - before >= _WRITE_FRAMES or time.monotonic() >= end:
                    return True
        return False
    except OSError:
        del taken.updates[before:]  # the write failed: they come again
        raise
    finally:
        tracker.note(taken.updates[before:])


def _take(calibrator: DurableCalibrator, group: list[StreamFrame] | Refused, taken: _Taken) -> None:
    from calibgraph.tracking.frame_group import update_all
    from calibgraph.tracking.streams import Refused

    if isinstance(group, Refused):
        taken.refused.append(group.message)
        return
    last = calibrator.tracker.frame
    new = [one for one in group if last is None or one.frame > last]
    taken.known += len(group) - len(new)
    for found in update_all(calibrator, new):
        if isinstance(found, Refused):
            taken.refused.append(found.message)
        else:
            taken.updates += found
