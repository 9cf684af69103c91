"""The command ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

import gc
import signal
from collections import Counter
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
from calibgraph.stdout import print_line, require_stdout
from calibgraph.tracking.assessment import Update, json_lines
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.frames import Item, frames_of
from calibgraph.tracking.tracker import UNSOLVABLE, IncrementalCalibrator, warm_up_tracker

Notify = Callable[[str], None]

STATE_FOLDER = "state"
_TOGETHER = 50  # frames of a table that are taken in by one write
_COUNTS = {"updates": "updates", "left out": "left out", "known": "known from before"}


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
        with calibrator:
            given = iter(lambda: stop.next_of(items, 1 if waits else _TOGETHER), [])
            counts = _follow(calibrator, given, notify)
            last = calibrator.tracker.frame
            if last is None and not stop.received:
                held = f"held no frame that could be used ({counts['left out']} left out); check it"
                raise FileError("standard input" if waits else source, held)
            result = _result(calibrator.tracker, state)
    notify(", ".join(f"{counts[key]} {text}" for key, text in _COUNTS.items()))
    if counts["known"] and not counts["updates"]:
        found = f"no frame comes after {last}"
        notify(f"warning: {found}; if that number is wrong, choose another --out")
    return result, [result.save(out)]


def _follow(
    calibrator: DurableCalibrator, given: Iterator[list[Item]], notify: Notify
) -> Counter[str]:
    """Update with each frame until there are no more; counts of frames.

    Each update is printed once it is on disk; after a crash, those of the last write come first,
    since they may not have been printed. A reader that goes away ends the run.

    Args:
        calibrator: takes the frames in.
        given: the frames, those of one write together.
        notify: called with warnings and events as sentences.
    """
    known = calibrator.tracker.frame if calibrator.resumed else None
    counts = Counter[str]()
    try:
        _report(calibrator.repeated, notify)
        for some in given:
            errors = [one for one in some if isinstance(one, CalibrationError)]
            right = [one for one in some if not isinstance(one, CalibrationError)]
            frames = [one for one in right if known is None or one.frame > known]
            if len(frames) < len(right) and not counts["known"]:
                notify(f"frame {right[0].frame} and others up to {known} are known: skipped")
            counts["known"] += len(right) - len(frames)
            for found in [*errors, *calibrator.update_all(frames)]:
                if isinstance(found, CalibrationError):
                    counts["left out"] += 1
                    notify(f"left out: {found}")
                else:
                    counts["updates"] += len(found)
                    _report(found, notify)
    except BrokenPipeError:
        notify("stopped: the reader of standard output is gone; all updates are on disk")
    return counts


def _report(updates: Sequence[Update], notify: Notify) -> None:
    for update, line in zip(updates, json_lines(updates), strict=True):
        print_line(line)
        for event in update.events:
            notify(f"frame {event.detected_frame}: {event}")


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
