"""The loop of ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from calibgraph.errors import CorrespondenceError, MotionError
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.history import History
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from calibgraph.tracking.update import Update, json_line

Notify = Callable[[str], None]

MOTION_FRAMES = 100
"""Once in so many frames, a motion that no vehicle has is an outlier of the odometry: its frame is
left out. Earlier or oftener, its unit or order is wrong, and slower frames are wrong unseen."""


@dataclass
class Run:
    """Frames in, updates out.

    Attributes:
        calibrator: takes the frames in.
        history: of the extrinsics; each update is added.
        write: called with each update as a line of JSON, once it is on disk; after a crash, first
            with the last one before it, which may have been written already. A BrokenPipeError
            ends the run.
        notify: called with warnings and events as sentences.
        updates: frames taken in.
        refused: input that was not a frame, or a frame that was left out.
        skipped: frames at the beginning that an earlier run had taken in already.
        sound: how many updates have come since a motion that no vehicle has.
    """

    calibrator: DurableCalibrator
    history: History
    write: Notify
    notify: Notify
    updates: int = 0
    refused: int = 0
    skipped: int = 0
    sound: int = 0

    def follow(self, items: Iterable[Item], *, every: int, stop: Callable[[], bool]) -> None:
        """Update with each frame until there are no more, or ``stop()``.

        Args:
            items: the frames.
            every: take every so-many-th frame.
            stop: called after each frame.

        Raises:
            MotionError: if several of ``MOTION_FRAMES`` have a motion that no vehicle has, or one
                of the first.
        """
        count, known = 0, self.calibrator.tracker.frame if self.calibrator.resumed else None
        try:
            for update in self.calibrator.repeated[-1:]:  # its line may not have been printed
                self._report(update)
            for item in items:
                if isinstance(item, Refused):
                    self._refuse(item.message, by_motion=item.by_motion)
                else:
                    if count % every == 0:
                        self._take(item, known)
                    count += 1
                if stop():  # before waiting for the next one, or matching it
                    break
        except BrokenPipeError:
            self.notify("stopped: the reader of standard output is gone; all updates are on disk")

    def report_counts(self) -> None:
        """Notify of what became of the frames."""
        self.notify(
            f"{self.updates} updates, {self.refused} left out, {self.skipped} known from before"
        )
        if self.skipped and not self.updates:
            found = f"no frame comes after {self.calibrator.tracker.frame}"
            self.notify(f"warning: {found}; if that number is wrong, choose another --out")

    def _take(self, frame: StreamFrame, known: int | None) -> None:
        """Update with a frame, unless an earlier run has, or it is refused."""
        if known is not None and frame.frame <= known and not self.updates:
            if not self.skipped:
                self.notify(f"frame {frame.frame} and others up to {known} are known: skipped")
            self.skipped += 1
            return
        try:
            update = self.calibrator.update(frame.table, frame=frame.frame)
        except CorrespondenceError as error:
            self._refuse(frame.why_not(error))
            return
        self.updates += 1
        self.sound += 1
        self._report(update)

    def _refuse(self, message: str, *, by_motion: bool = False) -> None:
        if by_motion and self.sound < MOTION_FRAMES:
            raise MotionError(
                f"{message}; correct the motion of all frames, and take another --out"
            )
        self.sound = 0 if by_motion else self.sound
        self.refused += 1
        self.notify(f"left out: {message}")

    def _report(self, update: Update) -> None:
        self.history.add(update)
        self.write(json_line(update))
        for event in update.events:
            self.notify(f"frame {event.detected_frame}: {event}")
