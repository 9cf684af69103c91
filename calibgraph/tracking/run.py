"""The loop of ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from calibgraph.errors import CorrespondenceError, MotionError
from calibgraph.model.correspondences import Correspondences
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.frame_group import in_groups, update_all
from calibgraph.tracking.frame_order import place_of
from calibgraph.tracking.history import History
from calibgraph.tracking.streams import Item, Refused, StreamFrame
from calibgraph.tracking.update import Update, json_lines

Notify = Callable[[str], None]

MOTION_FRAMES = 100
"""Once in so many frames, a motion that no vehicle has is an outlier of the odometry: its frame is
left out. Earlier or oftener, its unit or order is wrong, and slower frames are wrong unseen."""


@dataclass
class Stop:
    """Whether a signal to stop has come; called for the answer.

    Attributes:
        received: set by the first signal.
        interrupts: whether that signal is raised, too, as KeyboardInterrupt.
    """

    received: bool = False
    interrupts: bool = False

    def __call__(self) -> bool:
        """Whether it has come."""
        return self.received


@dataclass
class Run:
    """Frames in, updates out.

    Attributes:
        calibrator: takes the frames in.
        history: of the extrinsics; each update is added.
        write: called with each update as a line of JSON, once it is on disk; after a crash, first
            with those of the last write before it, which may have been written already. A
            BrokenPipeError ends the run.
        notify: called with warnings and events as sentences.
        together: frames that may be taken in at once; a source that does not wait has more.
        updates: frames taken in.
        refused: input that was not a frame, or a frame that was left out.
        skipped: frames at the beginning that an earlier run had taken in already.
        sound: how many updates have come since a motion that no vehicle has.
        places: by name, the frames of each; where none has a name, all are of one.
    """

    calibrator: DurableCalibrator
    history: History
    write: Notify
    notify: Notify
    together: int = 1
    updates: int = 0
    refused: int = 0
    skipped: int = 0
    sound: int = 0
    places: dict[str, list[int]] = field(default_factory=dict)

    def follow(self, items: Iterable[Item], *, every: int, stop: Callable[[], bool]) -> None:
        """Update with each frame until there are no more, or ``stop()``.

        Args:
            items: the frames.
            every: take every so-many-th frame.
            stop: called after each frame, or frames that come together.

        Raises:
            MotionError: if several of ``MOTION_FRAMES`` have a motion that no vehicle has, or one
                of the first.
        """
        known = self.calibrator.tracker.frame if self.calibrator.resumed else None
        try:
            self._report(self.calibrator.last_repeated)  # their lines may not have been printed
            for some in in_groups(_every(items, every), self.together):
                if isinstance(some, Refused):
                    self._refuse(some.message, by_motion=some.by_motion)
                else:
                    self._take(some, known)
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

    def _take(self, frames: Sequence[StreamFrame], known: int | None) -> None:
        """Update with frames, but for those that an earlier run has, or that are refused."""
        tables = {one.frame: one.table for one in frames}
        if known is not None and not self.updates:
            old = [one.frame for one in frames if one.frame <= known]
            if old and not self.skipped:
                self.notify(f"frame {old[0]} and others up to {known} are known: skipped")
            self.skipped += len(old)
            self._add_to_places(map(tables.__getitem__, old))
            frames = frames[len(old) :]
        for found in update_all(self.calibrator, frames):
            if isinstance(found, Refused):
                self._refuse(found.message)
            else:
                self.updates += len(found)
                self.sound += len(found)
                self._report(found)
                self._add_to_places(tables[update.frame] for update in found)

    def _add_to_places(self, tables: Iterable[Correspondences]) -> None:
        for table in filter(len, tables):
            with suppress(CorrespondenceError):  # of an earlier run, which has left it out
                self.places.setdefault(place_of(table), []).append(int(table.frame[0]))

    def _refuse(self, message: str, *, by_motion: bool = False) -> None:
        if by_motion and self.sound < MOTION_FRAMES:
            raise MotionError(
                f"{message}; correct the motion of all frames, and take another --out"
            )
        self.sound = 0 if by_motion else self.sound
        self.refused += 1
        self.notify(f"left out: {message}")

    def _report(self, updates: Sequence[Update]) -> None:
        for update, line in zip(updates, json_lines(updates), strict=True):
            self.history.add(update)
            self.write(line)
            for event in update.events:
                self.notify(f"frame {event.detected_frame}: {event}")


def _every(items: Iterable[Item], every: int) -> Iterator[Item]:
    """The items without all but every so-many-th frame."""
    count = 0
    for item in items:
        if isinstance(item, Refused) or count % every == 0:
            yield item
        count += isinstance(item, StreamFrame)
