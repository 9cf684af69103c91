"""The loop of ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from calibgraph.errors import CorrespondenceError
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.history import History
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from calibgraph.tracking.update import Update, json_line

Notify = Callable[[str], None]


@dataclass
class RunCounts:
    """Counts of a run.

    Attributes:
        updates: frames taken in.
        refused: input that was not a frame, or a frame that was left out.
        skipped: frames at the beginning that an earlier run had taken in already.
    """

    updates: int = 0
    refused: int = 0
    skipped: int = 0


def follow(
    items: Iterable[Item],
    calibrator: DurableCalibrator,
    history: History,
    *,
    every: int,
    stop: Callable[[], bool],
    write: Notify,
    notify: Notify,
) -> RunCounts:
    """Update with each frame until there are no more, or ``stop()``.

    Args:
        items: the frames.
        calibrator: takes them in.
        history: of the extrinsics; each update is added.
        every: take every so-many-th frame.
        stop: called after each frame.
        write: called with each update as a line of JSON, once it is on disk; after a crash, first
            with the last one before it, which may have been written already. A BrokenPipeError
            ends the loop.
        notify: called with warnings and events as sentences.
    """
    run = _Run(calibrator, history, write, notify)
    count = 0
    try:
        if calibrator.repeated is not None:  # its line may not have been printed
            run.report(calibrator.repeated)
        for item in items:
            if isinstance(item, Refused):
                run.refuse(item.message)
            else:
                if count % every == 0:
                    run.take(item)
                count += 1
            if stop():  # before waiting for the next one, or matching it
                break
    except BrokenPipeError:
        notify("stopped: the reader of standard output is gone; all updates are on disk")
    return run.counts


class _Run:
    """Handling of single items."""

    def __init__(
        self, calibrator: DurableCalibrator, history: History, write: Notify, notify: Notify
    ) -> None:
        self.counts = RunCounts()
        self._calibrator = calibrator
        self._history = history
        self._write, self._notify = write, notify
        self._resumed_at = calibrator.tracker.frame if calibrator.resumed else None

    def take(self, frame: StreamFrame) -> None:
        """Update with a frame, unless an earlier run has, or it is refused."""
        at = self._resumed_at
        if at is not None and frame.frame <= at and not self.counts.updates:
            if not self.counts.skipped:
                self._notify(f"frame {frame.frame} and others up to {at} are known: skipped")
            self.counts.skipped += 1
            return
        try:
            update = self._calibrator.update(frame.table, frame=frame.frame)
        except CorrespondenceError as error:
            self.refuse(str(error))
            return
        self.counts.updates += 1
        self.report(update)

    def refuse(self, message: str) -> None:
        """Count an item that is left out, and report it."""
        self.counts.refused += 1
        self._notify(f"left out: {message}")

    def report(self, update: Update) -> None:
        """Write an update, and report its events."""
        self._history.add(update)
        self._write(json_line(update))
        for event in update.events:
            self._notify(f"frame {event.detected_frame}: {event}")
