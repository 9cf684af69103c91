"""The command ``calibgraph track``: frames in, updates out, nothing lost in between."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import FrameType

from calibgraph.errors import (
    CalibrationError,
    CorrespondenceError,
    DatasetError,
    FileError,
    MotionError,
)
from calibgraph.io.bags import BagOptions
from calibgraph.io.dataset import load_dataset
from calibgraph.matching.burnt_in import hide_burnt_in
from calibgraph.matching.protocol import FullMatcher, Matcher
from calibgraph.matching.same_images import require_different_images
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.places import as_groups
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import START, Verdict
from calibgraph.report.as_json import print_line, require_stdout
from calibgraph.tracking.assessment import Update, json_lines
from calibgraph.tracking.dataset_frames import DatasetDrive, Stop
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.frame_order import place_of
from calibgraph.tracking.history import History
from calibgraph.tracking.streams import Item, Refused, StreamFrame, frames_of, in_groups, update_all
from calibgraph.tracking.tracker import UNSOLVABLE, IncrementalCalibrator, warm_up_tracker

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


STATE_FOLDER, PICTURE = "state", "track.png"
_TOGETHER = 50  # frames of a table that are read before they are taken in


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """The arguments of ``calibgraph track``.

    Attributes:
        rig: the initial guess.
        config: settings.
        out: folder for the state, the result and the picture.
        every: take every so-many-th frame.
        matcher: for the frames of datasets; None for tables.
        interval_s: between neighbouring clouds of folders, whose registration shows the motion.
        bag: how bags are read.
    """

    rig: Rig
    config: Config
    out: Path
    every: int = 1
    matcher: Matcher | None = None
    interval_s: float | None = None
    bag: BagOptions | None = None


def track(
    settings: Tracking, source: Sequence[Path], *, notify: Notify
) -> tuple[Calibration, list[Path]]:
    """Track a source until it ends or a signal comes; a line of JSON per update on stdout.

    Args:
        settings: see there.
        source: a table, or -; with a matcher, dataset folders.
        notify: called with warnings and events as sentences.

    Returns:
        The last estimate; the files written.

    Raises:
        CalibrationError: if the source, the rig or the state cannot be used, or there is no frame.
    """
    require_stdout()
    settings.rig.require_cameras()
    history = History()
    waits = str(source[0]) == "-"  # frames come at their own times
    with _stopped_by_signals() as stop:
        if waits:
            warm_up_tracker()
        items, calibrator, result_of = _opened(settings, source, stop, notify)
        gc.freeze()  # what is loaded by now stays: each full collection would visit it, for 0.1 s
        together = 1 if waits or settings.matcher is not None else _TOGETHER
        run = Run(calibrator, history, print_line, notify, together)
        with calibrator:
            run.follow(items, every=settings.every if settings.matcher is None else 1, stop=stop)
            if calibrator.tracker.frame is None and not stop():
                held = f"held no frame that could be used ({run.refused} left out); check it"
                raise FileError("standard input" if str(source[0]) == "-" else source[0], held)
            result = _result(calibrator.tracker, result_of, settings.out / STATE_FOLDER)
    run.report_counts()
    named = as_groups([*run.places.values()]) if any(run.places) else ()
    # The guess, not where the first batch has located it.
    verdicts = {name: _at_the_end(one) for name, one in result.camera_verdicts.items()}
    result = replace(result, initial_rig=settings.rig, places=named, camera_verdicts=verdicts)
    return result, _write_results(settings.out, result, history if run.updates else None)


def _at_the_end(verdict: Verdict) -> Verdict:
    """A camera without an estimate fails at the end, as one that `calibrate` does not find."""
    return replace(
        verdict,
        checks=tuple(
            replace(check, status="FAIL") if check.name == START else check
            for check in verdict.checks
        ),
    )


def _result(
    tracker: IncrementalCalibrator, of: Callable[[IncrementalCalibrator], Calibration], state: Path
) -> Calibration:
    try:
        return of(tracker)
    except UNSOLVABLE as error:
        why = str(error).strip().partition("\n")[0]
        raise CalibrationError(
            f"after frame {tracker.frame} the error bar cannot be solved for ({why}); all updates "
            f"are in {state}, and the same command goes on from there with more frames"
        ) from error


def _write_results(folder: Path, result: Calibration, history: History | None) -> list[Path]:
    written = [result.save(folder)]
    if history is not None:
        history.draw(folder / PICTURE)
        written.append(folder / PICTURE)
    return written


def _opened(
    settings: Tracking, source: Sequence[Path], stop: Stop, notify: Notify
) -> tuple[Iterator[Item], DurableCalibrator, Callable[[IncrementalCalibrator], Calibration]]:
    """The frames of the source, the durable tracker, and the function that gives its result."""
    result_of: Callable[[IncrementalCalibrator], Calibration]
    result_of = partial(IncrementalCalibrator.calibration, sources=True)
    folder = settings.out / STATE_FOLDER
    if settings.matcher is None:
        items = frames_of(str(source[0]), stop=stop)
        calibrator = DurableCalibrator(folder, settings.rig, settings.config)
    else:
        drive = _drive(settings, settings.matcher, source)
        calibrator = DurableCalibrator(
            folder,
            settings.rig,
            drive.config,
            begin=lambda: _first_rig(drive, settings.rig, notify),
        )
        items = drive.items(calibrator.tracker)
        result_of = partial(drive.result, stop=stop, notify=notify)
    for damage in calibrator.damages:
        notify(f"warning: {damage}")
    if calibrator.resumed:
        notify(f"going on after frame {calibrator.tracker.frame}")
    return items, calibrator, result_of


def _drive(settings: Tracking, matcher: Matcher, source: Sequence[Path]) -> DatasetDrive:
    try:
        data = load_dataset(source, settings.rig, bag=settings.bag, interval_s=settings.interval_s)
    except ValueError as error:  # of an option: a wrong argument of the user
        raise DatasetError(str(error)) from error
    full = FullMatcher(matcher)
    require_different_images(data, settings.rig)
    data = hide_burnt_in(replace(data, frames=data.frames[:: settings.every]), settings.rig)
    return DatasetDrive(data, full, settings.config.changed(stage1=full.stage1))


def _first_rig(drive: DatasetDrive, guess: Rig, notify: Notify) -> Rig:
    """The guess at the poses of the first frames' batch; a warning if they are not reliable."""
    verdict = drive.start.verdict
    if verdict.status == "FAIL":
        reasons = "; ".join(verdict.reasons)
        notify(f"warning: the first frames give no reliable start: {reasons}")
    return guess.moved_to(drive.start.rig.T_camera_lidar)


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
