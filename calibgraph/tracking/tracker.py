"""Recalibration while the robot drives: one frame in, one estimate out, in constant time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import gtsam
import numpy as np

from calibgraph.errors import CorrespondenceError, FileError, in_words
from calibgraph.files import require_file, write_bytes
from calibgraph.graph.latent_poses import latent_pose_graph
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.tracking.absorption import (
    absorb,
    at_minimum,
    begin_frames,
    blocks_by_camera,
    count_absent,
    count_repeats,
    select_agreeing,
)
from calibgraph.tracking.assessment import Assessment, MeasureOnFrames, assess, to_calibration
from calibgraph.tracking.closed_places import ClosedPlaces, settle
from calibgraph.tracking.epochs import close_epoch
from calibgraph.tracking.events import Event
from calibgraph.tracking.frame_group import Blocks, usual_frames
from calibgraph.tracking.frame_order import (
    Incoming,
    incoming,
    unsolvable,
    with_place,
    without_repeats,
)
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.restart import handle_small_step, restart_after_step
from calibgraph.tracking.start import start_cameras
from calibgraph.tracking.state import State
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.step_detection import detect_small_step, detect_step
from calibgraph.tracking.stream_tables import StreamFrame
from calibgraph.tracking.update import Update, make_updates

UNSOLVABLE = (RuntimeError, np.linalg.LinAlgError)  # what gtsam and numpy raise


class IncrementalCalibrator:
    """All cameras' extrinsics, updated frame by frame.

    Each frame costs the same, however many came before: live epochs keep their matches, older ones
    are a quadratic about the estimate at the time (true Hessian, so the next order is the third),
    with the gate of that time. All else is as in a batch.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        config: settings; the preset ``auto`` if None. ``config.tracking`` is for the tracker.
    """

    _state: State
    _epoch_start: State
    _since_epoch_start: list[tuple[Incoming, ...]]
    _closed: ClosedPlaces
    _assessed: tuple[State, Assessment] | None = None

    def __init__(self, rig: Rig, config: Config | None = None) -> None:
        self._resume(State.initial(rig, config or Config()))

    @property
    def rig(self) -> Rig:
        """The rig with the present estimates."""
        return self.calibration().rig

    @property
    def initial_rig(self) -> Rig:
        """The rig with the initial guess."""
        return self._state.rig

    @property
    def config(self) -> Config:
        """Its settings."""
        return self._state.config

    @property
    def frame(self) -> int | None:
        """Number of the last frame, None before the first."""
        return self._state.frame

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the places that are kept apart, the last visited last."""
        visited = *self._state.places.names[1:], *(f.place for f in self._state.live_frames)
        return tuple(reversed(dict.fromkeys(reversed(visited))))

    def calibration(
        self, measure: MeasureOnFrames | None = None, *, sources: bool = False
    ) -> Calibration:
        """The present estimate as a batch's result; posteriors by images widen its error bars."""
        return to_calibration(self._state, self._assess(), measure, sources=sources)

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal are reported, as :meth:`Solution.graph`.

        Its variables are those of ``calibgraph.graph.variables``; places that no frame of the open
        epoch is of are one factor, once it has a frame. With a preset of the paper it is Eq. 5,
        without its marginal.
        """
        if self.config.preset != "auto":
            return self._closed.equation_5(self._state)
        return latent_pose_graph(self._assess().window.model)

    def update(
        self, table: Correspondences, *, frame: int | None = None, place: str | int | None = None
    ) -> Update:
        """Take in one frame: gate it, add its inliers; then test whether something moved.

        Args:
            table: the correspondences of one frame, of all cameras that have some.
            frame: its number, which an empty table does not have.
            place: where the vehicle is, by any name or number: frames of one place, within some 20
                m, share errors, also after coming back. None: by the table's metadata (``place``,
                or the list of ``places`` that has the frame); frames of which nothing is known are
                all of one place.

        Raises:
            CorrespondenceError: if the table holds several frames, a camera that the rig does not
                have, a frame that does not come after the last one, or wrong metadata. Nothing has
                changed then.
        """
        one = incoming(self._state, with_place(table, place), frame)
        new = without_repeats(self._state, one.table)
        blocks = blocks_by_camera(self._state, new)
        with self._undone_on_error([one]):
            self._state = count_repeats(self._state, one.table, new)
            return self._take(one, new, blocks)

    def update_together(self, frames: Sequence[StreamFrame]) -> list[Update]:
        """Take in the first of some frames at once: one solve, one assessment.

        As many as show nothing unusual, up to the end of an epoch. All their updates have the
        estimate after the last of them. None is taken in if the first needs :meth:`update`.
        """
        group, blocks = usual_frames(self._state, frames)
        if not group:
            return []
        try:
            with self._undone_on_error(group):
                return self._take_together(group, blocks)
        except CorrespondenceError:  # of one of them
            return []

    @contextmanager
    def _undone_on_error(self, frames: Sequence[Incoming]) -> Iterator[None]:
        """Frames are taken in inside; after an error of any kind nothing of them remains."""
        start, since = self._epoch_start, list(self._since_epoch_start)
        try:
            self._state = begin_frames(self._state, frames)
            self._since_epoch_start.append(tuple(frames))
            yield
        except BaseException as error:
            self._resume(start)
            for earlier in since:
                self._repeat(earlier)
            if isinstance(error, UNSOLVABLE):
                raise unsolvable(frames[0].number, error) from error
            raise

    def _repeat(self, frames: Sequence[Incoming]) -> None:
        """Take in again what has been taken in at once."""
        again = [StreamFrame(one.number, one.table) for one in frames]
        if len(again) == 1:
            self.update(again[0].table, frame=again[0].frame)
        elif len(self.update_together(again)) < len(frames):
            raise StateError("has frames that do not go together")

    def _take(self, one: Incoming, table: Correspondences, blocks: Blocks) -> Update:
        """Absorb the blocks that agree, set aside the others, detect events."""
        self._state, agreeing = select_agreeing(self._state, self._closed, blocks)
        self._state, (used,) = absorb(self._state, self._closed, agreeing)
        self._state, events = start_cameras(self._state, table, blocks)
        if events:
            self._rebuild()
        self._state, seen = count_absent(self._state, used, one)
        detected = detect_step(self._state)
        if detected is not None:  # moved so far that frames disagree with the estimate
            self._state, moved = restart_after_step(self._state, detected)
            self._rebuild()
            seen += moved
        events += seen + self._end_frames()
        (update,) = make_updates(self._state, self._assess(), [(one, events, used)])
        return update

    def _take_together(self, group: Sequence[Incoming], blocks: Blocks) -> list[Update]:
        """Absorb frames that all agree with the estimates."""
        self._state, used = absorb(self._state, self._closed, blocks, len(group))
        taken = []
        for one, own in zip(group, used, strict=True):
            again = count_repeats(self._state, one.table, one.table)
            self._state, events = count_absent(again, own, one)
            taken.append((one, events, own))
        taken[-1][1].extend(self._end_frames())
        return make_updates(self._state, self._assess(), taken)

    def _end_frames(self) -> list[Event]:
        """The end of the epoch if its frames fill it."""
        if self._closed.state.findings != self._state.findings:
            self._closed = ClosedPlaces.of(self._state)
        if len(self._state.epochs[-1].frames) < self._state.config.tracking.epoch_frames:
            return []
        return self._close_epoch()

    def _assess(self) -> Assessment:
        """Assess the estimates, once: the sums over closed epochs are at hand."""
        if self._assessed is None or self._assessed[0] is not self._state:
            before = self._assessed and self._assessed[1].window
            self._assessed = self._state, assess(self._state, self._closed, before)
        return self._assessed[1]

    def to_bytes(self) -> bytes:
        """The tracker as bytes, from which :meth:`from_bytes` continues with the same numbers."""
        return encode((self._epoch_start, self._since_epoch_start), "state")

    @staticmethod
    def from_bytes(data: bytes) -> IncrementalCalibrator:
        """The tracker that :meth:`to_bytes` has written: its next updates are the same.

        Raises:
            CalibrationError: if the bytes are damaged or of another format.
        """
        state, since = decode(data, "state")
        try:
            tracker = IncrementalCalibrator(state.rig, state.config)
            tracker._resume(state)
            for frames in since:
                tracker._repeat(frames)
        except Exception as error:  # of any kind: parts of the state may contradict each other
            raise StateError(f"is no tracker's state ({in_words(error)})") from error
        return tracker

    def save(self, path: Path | str) -> None:
        """Write the tracker to a file, atomically; :meth:`load` continues from there."""
        write_bytes(Path(path), self.to_bytes())

    @staticmethod
    def load(path: Path | str) -> IncrementalCalibrator:
        """Read a tracker that :meth:`save` has written.

        Raises:
            FileError: if the file is missing, damaged, or not of this format.
        """
        try:
            return IncrementalCalibrator.from_bytes(require_file(Path(path)).read_bytes())
        except StateError as error:
            raise FileError(path, f"{error}; track anew from a rig") from error

    def _resume(self, state: State) -> None:
        """Continue from a state: at the start, at each new epoch, and after an error."""
        self._state = state
        self._epoch_start = state
        self._since_epoch_start = []
        self._rebuild()

    def _rebuild(self) -> None:
        """Start from the state anew, after anything but a frame has changed it."""
        self._closed, self._assessed = ClosedPlaces.of(self._state), None
        self._state = at_minimum(self._state, self._closed)

    def _close_epoch(self) -> list[Event]:
        """Summarize the oldest live epoch, test for a small step, begin another."""
        state = self._state
        if self._assessed is not None and self._assessed[0].epochs[-1].frames:
            state = changed(state, optimum=self._assessed[1].newest(state.optimum))
        self._state, events = close_epoch(state)
        detected = detect_small_step(self._state)
        if detected is not None:
            self._state, more = handle_small_step(self._state, detected)
            events += more
        self._resume(settle(self._state))
        return events
