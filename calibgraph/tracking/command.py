"""The command ``calibgraph track``: a source, a durable tracker, and the files at the end."""

from __future__ import annotations

import gc
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from types import FrameType

from calibgraph.errors import FileError
from calibgraph.io.dataset import load_dataset
from calibgraph.matching.places import PlaceFinder
from calibgraph.matching.protocol import Matcher, to_full_matcher
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.rig import Rig
from calibgraph.report.as_json import print_line, require_stdout
from calibgraph.tracking.dataset_frames import (
    first_frames,
    frames_of_batch,
    matched_frames,
    with_places,
)
from calibgraph.tracking.durable import DurableCalibrator
from calibgraph.tracking.history import History
from calibgraph.tracking.place_sums import MOST_PLACES
from calibgraph.tracking.preload import warm_up_tracker
from calibgraph.tracking.run import Notify, RunCounts, follow
from calibgraph.tracking.streams import Item, frames_of

STATE_FOLDER, PICTURE = "state", "track.png"


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """The arguments of ``calibgraph track``.

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


def track(
    settings: Tracking, source: Sequence[Path], *, notify: Notify
) -> tuple[Calibration, list[Path]]:
    """Track a source until it ends or a signal comes; a line of JSON per update on stdout.

    Args:
        settings: see there.
        source: a table, a folder, or -; with a matcher, dataset folders.
        notify: called with warnings and events as sentences.

    Returns:
        The last estimate; the files written.

    Raises:
        CalibrationError: if the source, the rig or the state cannot be used, or there is no frame.
    """
    require_stdout()
    history = History()
    with _stopped_by_signals() as stop:
        if settings.follow or str(source[0]) == "-":  # frames come at their own times
            warm_up_tracker()
        items, calibrator = _opened(settings, source, stop, notify)
        gc.freeze()  # what is loaded by now stays: each full collection would visit it, for 0.1 s
        with calibrator:
            counts = follow(
                items,
                calibrator,
                history,
                every=settings.every if settings.matcher is None else 1,
                stop=stop,
                write=print_line,
                notify=notify,
            )
            if calibrator.tracker.frame is None and not stop():
                held = f"held no frame that could be used ({counts.refused} left out); check it"
                raise FileError("standard input" if str(source[0]) == "-" else source[0], held)
            result = calibrator.tracker.calibration()
    _report_counts(counts, calibrator.tracker.frame, notify)
    return result, _write_results(settings.out, result, history if counts.updates else None)


def _report_counts(counts: RunCounts, last: int | None, notify: Notify) -> None:
    notify(
        f"{counts.updates} updates, {counts.refused} left out, {counts.skipped} known from before"
    )
    if counts.skipped and not counts.updates:
        found = f"no frame comes after {last}"
        notify(f"warning: {found}; if that number is wrong, choose another --out")


def _write_results(folder: Path, result: Calibration, history: History | None) -> list[Path]:
    written = [result.save(folder)]
    if history is not None:
        history.draw(folder / PICTURE)
        written.append(folder / PICTURE)
    return written


def _opened(
    settings: Tracking, source: Sequence[Path], stop: Callable[[], bool], notify: Notify
) -> tuple[Iterator[Item], DurableCalibrator]:
    """The frames of the source, and the durable tracker."""
    folder = settings.out / STATE_FOLDER
    if settings.matcher is None:
        items = frames_of(str(source[0]), follow=settings.follow, stop=stop)
        return items, _report_recovery(
            DurableCalibrator(folder, settings.rig, settings.config), notify
        )
    matcher = to_full_matcher(settings.matcher)
    data = load_dataset(source, settings.rig)
    data = replace(data, frames=data.frames[:: settings.every])
    config = settings.config.changed(stage1=matcher.stage1)
    first: list[Calibration] = []

    def begin() -> Rig:
        first.append(first_frames(data, matcher, config))
        if first[0].verdict.status == "FAIL":
            reasons = "; ".join(first[0].verdict.reasons)
            notify(f"warning: the first frames give no reliable start: {reasons}")
        return first[0].rig

    calibrator = _report_recovery(
        DurableCalibrator(folder, settings.rig, config, begin=begin), notify
    )
    taken, count = calibrator.tracker.frame, config.tracking.start_frames
    head: Iterator[Item] = iter(())
    if taken is None or taken < data.frames[:count][-1].index:
        # Also after a crash among the first frames: they continue from the same batch.
        head = frames_of_batch(first[0] if first else first_frames(data, matcher, config))
    rest = [f for f in data.frames[count:] if taken is None or f.index > taken]
    later = matched_frames(
        replace(data, frames=tuple(rest)), matcher, config, lambda: calibrator.tracker.rig
    )
    rig = calibrator.tracker.initial_rig
    finder = PlaceFinder(rig, most_places=MOST_PLACES, seed=config.seed)
    return with_places(chain(head, later), data, finder, calibrator.tracker.places), calibrator


def _report_recovery(calibrator: DurableCalibrator, notify: Notify) -> DurableCalibrator:
    for damage in calibrator.damages:
        notify(f"warning: {damage}")
    if calibrator.resumed:
        notify(f"going on after frame {calibrator.tracker.frame}")
    return calibrator


@contextmanager
def _stopped_by_signals() -> Iterator[Callable[[], bool]]:
    """In the body, the first SIGTERM or SIGINT only sets the flag that is returned.

    A second one has its usual effect: a blocked output may delay the reaction to the first.
    """
    received: list[int] = []

    def receive(number: int, _: FrameType | None) -> None:
        received.append(number)
        restore()

    def restore() -> None:
        for kind, handler in before.items():
            signal.signal(kind, handler)

    before = {kind: signal.signal(kind, receive) for kind in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(received)
    finally:
        restore()
