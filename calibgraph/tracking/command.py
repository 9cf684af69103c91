"""The command ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from types import FrameType

from calibgraph.errors import CalibrationError, FileError
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import START
from calibgraph.report.as_json import print_line, require_stdout
from calibgraph.tracking.assessment import Update, json_lines
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.frames import Item, frames_of
from calibgraph.tracking.tracker import UNSOLVABLE, IncrementalCalibrator, warm_up_tracker

Notify = Callable[[str], None]

STATE_FOLDER = "state"
_TOGETHER = 50  # frames of a table that are taken in by one write


def track(
    rig: Rig,
    source: str,
    *,
    config: Config,
    out: Path,
    notify: Notify,
) -> tuple[Calibration, list[Path]]:
    """Track a source until it ends or a signal comes; a line of JSON per update on stdout.

    Args:
        rig: the initial guess.
        source: a table, or "-" for standard input.
        config: settings.
        out: folder for the state and the result.
        notify: called with warnings and events as sentences.

    Returns:
        The last estimate; the files written.

    Raises:
        CalibrationError: if the source, the rig or the state cannot be used, or there is no frame.
    """
    require_stdout()
    rig.require_cameras()
    state, waits = out / STATE_FOLDER, source == "-"  # frames come at their own times
    with _stopped_by_signals() as stop:
        if waits:
            warm_up_tracker()
        items = frames_of(source)
        calibrator = DurableCalibrator(state, rig, config)
        if calibrator.resumed:
            notify(f"going on after frame {calibrator.tracker.frame}")
        gc.freeze()  # what is loaded by now stays: each full collection would visit it, for 0.1 s
        run = Run(calibrator, notify)
        with calibrator:
            run.follow(items, 1 if waits else _TOGETHER, stop)
            if calibrator.tracker.frame is None and not stop.received:
                held = f"held no frame that could be used ({run.left_out} left out); check it"
                raise FileError("standard input" if waits else source, held)
            result = _result(calibrator.tracker, state)
    run.report_counts()
    return result, [result.save(out)]


@dataclass
class Run:
    """Frames in, updates out, and what became of the frames.

    Attributes:
        calibrator: takes the frames in.
        notify: called with warnings and events as sentences.
        updates: frames taken in.
        left_out: input that was not a frame, or a frame that was left out.
        skipped: frames at the beginning that an earlier run had taken in already.
    """

    calibrator: DurableCalibrator
    notify: Notify
    updates: int = 0
    left_out: int = 0
    skipped: int = 0

    def follow(self, items: Iterator[Item], together: int, stop: Stop) -> None:
        """Update with each frame until there are no more, or a signal has come.

        Each update is printed once it is on disk; after a crash, those of the last write come
        first, since they may not have been printed. A reader that goes away ends the run.

        Args:
            items: the frames.
            together: how many are taken in by one write, if they are at hand.
            stop: interrupts the wait for the next frame.
        """
        known = self.calibrator.tracker.frame if self.calibrator.resumed else None
        try:
            self._report(self.calibrator.repeated)
            while some := stop.next_of(items, together):
                errors = [one for one in some if isinstance(one, CalibrationError)]
                given = [one for one in some if not isinstance(one, CalibrationError)]
                frames = [one for one in given if known is None or one.frame > known]
                if len(frames) < len(given) and not self.skipped:
                    self.notify(
                        f"frame {given[0].frame} and others up to {known} are known: skipped"
                    )
                self.skipped += len(given) - len(frames)
                for found in [*errors, *self.calibrator.update_all(frames)]:
                    if isinstance(found, CalibrationError):
                        self.left_out += 1
                        self.notify(f"left out: {found}")
                    else:
                        self.updates += len(found)
                        self._report(found)
        except BrokenPipeError:
            self.notify("stopped: the reader of standard output is gone; all updates are on disk")

    def report_counts(self) -> None:
        """Notify of what became of the frames."""
        self.notify(
            f"{self.updates} updates, {self.left_out} left out, {self.skipped} known from before"
        )
        if self.skipped and not self.updates:
            found = f"no frame comes after {self.calibrator.tracker.frame}"
            self.notify(f"warning: {found}; if that number is wrong, choose another --out")

    def _report(self, updates: Sequence[Update]) -> None:
        for update, line in zip(updates, json_lines(updates), strict=True):
            print_line(line)
            for event in update.events:
                self.notify(f"frame {event.detected_frame}: {event}")


def _result(tracker: IncrementalCalibrator, state: Path) -> Calibration:
    """The last estimate; a camera without one fails, as one that `calibrate` does not find."""
    try:
        result = tracker.calibration()
    except UNSOLVABLE as error:
        why = str(error).strip().partition("\n")[0]
        raise CalibrationError(
            f"after frame {tracker.frame} the error bar cannot be solved for ({why}); all updates "
            f"are in {state}, and the same command goes on from there with more frames"
        ) from error
    verdicts = {
        name: replace(one, checks=tuple(
            replace(check, status="FAIL") if check.name == START else check for check in one.checks
        ))
        for name, one in result.camera_verdicts.items()
    }  # fmt: skip
    return replace(result, camera_verdicts=verdicts)


@dataclass
class Stop:
    """Whether a signal to stop has come.

    Attributes:
        received: set by the first signal.
        interrupts: whether that signal is raised, too, as KeyboardInterrupt.
    """

    received: bool = False
    interrupts: bool = False

    def next_of(self, items: Iterator[Item], most: int) -> list[Item]:
        """The next items; none at the end, or if a signal has come or comes while they are due."""
        self.interrupts = True
        try:
            return [] if self.received else [*islice(items, most)]
        except KeyboardInterrupt:
            return []
        finally:
            self.interrupts = False


@contextmanager
def _stopped_by_signals() -> Iterator[Stop]:
    """In the body, the first SIGTERM or SIGINT sets the flag, and ends what may be interrupted.

    A second one has its usual effect: a blocked output may delay the reaction to the first.
    """
    stop = Stop()

    def receive(_: int, __: FrameType | None) -> None:
        stop.received = True
        restore()
        if stop.interrupts:
            raise KeyboardInterrupt

    def restore() -> None:
        for kind, handler in before.items():
            signal.signal(kind, handler)

    before = {kind: signal.signal(kind, receive) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        restore()
