"""The loop of ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from calibgraph.errors import CorrespondenceError
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.history import History
from calibgraph.tracking.report import json_line
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from calibgraph.tracking.tracker import Update

Say = Callable[[str], None]


@dataclass
class Done:
    """What a run has done.

    Attributes:
        updates: frames taken in.
        refused: input that was no frame, or a frame that could not be taken.
        known: frames at the beginning that an earlier run had taken in already.
    """

    updates: int = 0
    refused: int = 0
    known: int = 0


def follow(
    items: Iterable[Item],
    calibrator: DurableCalibrator,
    history: History,
    *,
    every: int,
    stop: Callable[[], bool],
    write: Say,
    tell: Say,
) -> Done:
    """Update with each frame until there are no more, or ``stop()``.

    Args:
        items: the frames.
        calibrator: takes them in.
        history: keeps what becomes of the extrinsics.
        every: take every so-many-th frame.
        stop: asked after each frame.
        write: given each update as a line of JSON, once it is on disk; after a crash first the
            last one from before it, which may or may not have been written. A BrokenPipeError ends
            the loop.
        tell: given warnings and events as sentences.
    """
    run = _Run(calibrator, history, write, tell)
    count = 0
    try:
        if calibrator.repeated is not None:  # whether its line was printed nobody knows
            run.tell_of(calibrator.repeated)
        for item in items:
            if isinstance(item, Refused):
                run.refuse(item.message)
            else:
                if count % every == 0:
                    run.take(item)
                count += 1
            if stop():  # before the next one is waited for, or matched
                break
    except BrokenPipeError:
        tell("stopped: nobody reads standard output any more; what was done is on disk")
    return run.done


class _Run:
    """What is done with one item."""

    def __init__(
        self, calibrator: DurableCalibrator, history: History, write: Say, tell: Say
    ) -> None:
        self.done = Done()
        self._calibrator = calibrator
        self._history = history
        self._write, self._tell = write, tell
        self._resumed_at = calibrator.tracker.frame if calibrator.resumed else None

    def take(self, frame: StreamFrame) -> None:
        """Update with a frame, unless an earlier run has, or it is refused."""
        at = self._resumed_at
        if at is not None and frame.frame <= at and not self.done.updates:
            if not self.done.known:
                self._tell(f"frame {frame.frame} and others up to {at} are known: skipped")
            self.done.known += 1
            return
        try:
            update = self._calibrator.update(frame.table, frame=frame.frame)
        except CorrespondenceError as error:
            self.refuse(str(error))
            return
        self.done.updates += 1
        self.tell_of(update)

    def refuse(self, message: str) -> None:
        """Say what is left out."""
        self.done.refused += 1
        self._tell(f"left out: {message}")

    def tell_of(self, update: Update) -> None:
        """Give an update out."""
        self._history.add(update)
        self._write(json_line(update))
        for event in update.events:
            self._tell(f"frame {event.detected_frame}: {event}")
