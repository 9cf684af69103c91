"""What ``calibgraph track`` does: a source, a durable tracker, and the files at the end."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import FrameType

from calibgraph.errors import FileError
from calibgraph.io.dataset import load_dataset
from calibgraph.matching.protocol import Matcher, to_full_matcher
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.rig import Rig
from calibgraph.tracking.dataset_frames import first_frames, frames_of_batch, matched_frames
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.history import History
from calibgraph.tracking.run import Say, follow
from calibgraph.tracking.streams import Item, frames_of

STATE_FOLDER, PICTURE = "state", "track.png"


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """What is wanted of ``calibgraph track``.

    Attributes:
        rig: the initial guess.
        config: settings.
        out: folder for the state, the result and the picture.
        every: take every so-many-th frame.
        follow: wait for new files.
        matcher: for the frames of datasets; None for tables.
    """

    rig: Rig
    config: Config
    out: Path
    every: int = 1
    follow: bool = False
    matcher: Matcher | None = None


def track(wanted: Tracking, source: Sequence[Path], *, tell: Say) -> tuple[Calibration, list[Path]]:
    """Track a source until it ends or a signal comes; a line of JSON per update on stdout.

    Args:
        wanted: see there.
        source: a table, a folder, or -; with a matcher, dataset folders.
        tell: given warnings and events.

    Returns:
        The last estimate; the files written.

    Raises:
        CalibrationError: if the source, the rig or the state cannot be used, or nothing came.
    """
    if sys.stdout is None:
        raise FileError("standard output", "is closed; give the updates somewhere to go")
    with _stopped_by_signals() as stop:
        items, calibrator = _opened(wanted, source, stop, tell)
        history = History()
        with calibrator:
            done = follow(
                items,
                calibrator,
                history,
                every=wanted.every if wanted.matcher is None else 1,
                stop=stop,
                write=_write_line,
                tell=tell,
            )
            if calibrator.tracker.frame is None and not stop():
                held = f"held no frame that could be used ({done.refused} left out); check it"
                raise FileError("standard input" if str(source[0]) == "-" else source[0], held)
            result = calibrator.tracker.calibration()
    tell(f"{done.updates} updates, {done.refused} left out, {done.known} known from before")
    written = [result.save(wanted.out)]
    if done.updates:
        history.draw(wanted.out / PICTURE)
        written.append(wanted.out / PICTURE)
    return result, written


def _opened(
    wanted: Tracking, source: Sequence[Path], stop: Callable[[], bool], tell: Say
) -> tuple[Iterator[Item], DurableCalibrator]:
    """The frames of the source and what takes them in."""
    folder = wanted.out / STATE_FOLDER
    if wanted.matcher is None:
        items = frames_of(str(source[0]), follow=wanted.follow, stop=stop)
        return items, _told(DurableCalibrator(folder, wanted.rig, wanted.config), tell)
    matcher = to_full_matcher(wanted.matcher)
    data = load_dataset(source, wanted.rig)
    data = replace(data, frames=data.frames[:: wanted.every])
    config = wanted.config.changed(stage1=matcher.stage1)
    first: list[Calibration] = []

    def begin() -> Rig:
        first.append(first_frames(data, matcher, config))
        if first[0].verdict.status == "FAIL":
            reasons = "; ".join(first[0].verdict.reasons)
            tell(f"warning: the first frames give no start that can be trusted: {reasons}")
        return first[0].rig

    calibrator = _told(DurableCalibrator(folder, wanted.rig, config, begin=begin), tell)
    taken, count = calibrator.tracker.frame, config.tracking.start_frames
    head: Iterator[Item] = iter(())
    if taken is None or taken < data.frames[:count][-1].index:
        # Also after a crash among the first frames: they go on from the same batch.
        head = frames_of_batch(first[0] if first else first_frames(data, matcher, config))
    rest = [f for f in data.frames[count:] if taken is None or f.index > taken]
    later = matched_frames(
        replace(data, frames=tuple(rest)), matcher, config, lambda: calibrator.tracker.rig
    )
    return chain(head, later), calibrator


def _told(calibrator: DurableCalibrator, tell: Say) -> DurableCalibrator:
    for damage in calibrator.damages:
        tell(f"warning: {damage}")
    if calibrator.resumed:
        tell(f"going on after frame {calibrator.tracker.frame}")
    return calibrator


@contextmanager
def _stopped_by_signals() -> Iterator[Callable[[], bool]]:
    """While it lasts, the first SIGTERM or SIGINT only asks to stop.

    A second one does what it did before: someone who does not read may keep the first waiting.
    """
    asked: list[int] = []

    def ask(number: int, _: FrameType | None) -> None:
        asked.append(number)
        restore()

    def restore() -> None:
        for kind, handler in before.items():
            signal.signal(kind, handler)

    before = {kind: signal.signal(kind, ask) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(asked)
    finally:
        restore()


def _write_line(line: str) -> None:
    """Print a line at once.

    Raises:
        BrokenPipeError: if nobody reads any more.
        FileError: if it cannot be written.
    """
    try:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()
    except OSError as error:
        # Python tries again at its end to write what is left, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise
        raise FileError("standard output", f"cannot be written to ({error}); restart") from error
