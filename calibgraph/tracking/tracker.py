"""Recalibration while the robot drives: one frame in, one estimate out, in constant time."""

from __future__ import annotations

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
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.shared_error import with_common_error
from calibgraph.tracking.absorption import (
    absorb,
    at_minimum,
    blocks_by_camera,
    count_absent,
    select_agreeing,
    with_open_frames,
    with_poses,
)
from calibgraph.tracking.assessment import Assessment, assess, to_calibration
from calibgraph.tracking.closed_places import STEPS, ClosedPlaces, refine, settle
from calibgraph.tracking.epochs import at_offsets, close_epoch
from calibgraph.tracking.events import Event
from calibgraph.tracking.frame_order import (
    PLACE,
    number_and_stamp,
    with_metadata_per_frame,
    with_place,
    without_repeats,
)
from calibgraph.tracking.frozen import replace
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.offset_search import explaining_offsets, follow
from calibgraph.tracking.offsets import delayed, with_motion_in_use
from calibgraph.tracking.restart import handle_small_step, restart_after_step
from calibgraph.tracking.start import start_cameras
from calibgraph.tracking.state import State
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.step_detection import detect_small_step, detect_step
from calibgraph.tracking.update import Update, make_update

_UNSOLVABLE = (RuntimeError, np.linalg.LinAlgError)  # what gtsam and numpy raise


class IncrementalCalibrator:
    """All cameras' extrinsics, updated frame by frame.

    Each frame costs the same, however many came before: live epochs keep their matches, older ones
    are a summary of constant size, a quadratic about the estimate at the time (true Hessian, so the
    next order is the third), with the gate of that time. All else is as in a batch.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        config: settings; the preset ``auto`` if None. ``config.tracking`` is for the tracker.
    """

    _state: State
    _epoch_start: State
    _since_epoch_start: list[tuple[int, Correspondences]]

    _assessed: tuple[State, Assessment] | None = None
    _closed: ClosedPlaces

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
    def place(self) -> str:
        """Name of the place of the last frame; empty if it is not known."""
        return self._state.live_frames[-1].place if self._state.live_frames else ""

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the places that are kept apart, the last visited last."""
        visited = *self._state.places.names[1:], *(f.place for f in self._state.live_frames)
        return tuple(reversed(dict.fromkeys(reversed(visited))))

    def calibration(self) -> Calibration:
        """The present estimate as a result of the same type as a batch solve's."""
        return to_calibration(self._state, self._assess())

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The graph whose optimum and marginal are reported, as :meth:`Solution.graph`.

        Its variables are those of ``calibgraph.graph.variables``. Places that no frame of the open
        epoch is of are one factor. With a preset of the paper it is Eq. 5, whose optimum alone is
        reported.
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
        table = with_common_error(table, self._state.config)
        if len(table):
            known = self._state.knows_motion
            table = with_motion_in_use(self._state.rig, self._state.config, table, known)
        table = with_metadata_per_frame(with_place(table, place))
        number, stamp = number_and_stamp(table, frame, self._state)
        new = without_repeats(self._state, table)
        blocks = blocks_by_camera(self._state, new)
        start, since = self._epoch_start, list(self._since_epoch_start)
        try:
            self._begin_frame(number, stamp, table)
            return self._take(new, blocks)
        except BaseException as error:  # of any kind: nothing of the frame must remain
            self._resume(start)
            for earlier, its_table in since:
                self.update(its_table, frame=earlier)
            if isinstance(error, _UNSOLVABLE):
                raise CorrespondenceError(
                    f"frame {number}: with its matches the estimate cannot be solved for "
                    f"({str(error).strip().splitlines()[0]}); it is left out",
                    frame=number,
                ) from error
            raise

    def _begin_frame(self, number: int, stamp: int | None, table: Correspondences) -> None:
        self._since_epoch_start.append((number, table))
        state = self._state
        place = table.metadata.get(PLACE, "")
        state = replace(
            state,
            frame=number,
            stamp_ns=state.stamp_ns if stamp is None else stamp,
            updates=state.updates + 1,
            findings=table.findings if len(table) else state.findings,
        )
        in_time = state.offsets is not None
        frame = LiveFrame.empty(number, len(state.names), place, in_time=in_time)
        self._state = with_open_frames(state, frame)

    def _take(self, table: Correspondences, blocks: dict[int, CameraBlock]) -> Update:
        """Absorb the blocks that agree, set aside the others, detect events."""
        blocks = self._at_explaining_offsets(blocks)
        self._state, agreeing = select_agreeing(self._state, self._closed, blocks)
        self._state, (used,) = absorb(self._state, self._closed, agreeing)
        self._state, events = start_cameras(self._state, table, blocks)
        if events:
            self._rebuild()
        last = self._state.frame or 0, self._state.stamp_ns
        self._state, seen = count_absent(self._state, used, last)
        events += seen + self._restart_after_step()
        self._refine()
        if len(self._state.epochs[-1].frames) >= self._state.config.tracking.epoch_frames:
            events += self._close_epoch()
        return make_update(self._state, self._assess(), tuple(events), used)

    def _at_explaining_offsets(self, blocks: dict[int, CameraBlock]) -> dict[int, CameraBlock]:
        """The blocks, and the state, at the time offsets with which they agree."""
        before, sums = self._state.offsets, self._closed.all_sums(self._state)
        offsets = explaining_offsets(self._state, sums, blocks)
        if offsets is None or before is None:
            return blocks
        state = with_poses(self._state, follow(self._state, sums, offsets))
        self._state = replace(at_offsets(state, offsets), optimum=None)
        self._rebuild()
        later_s = offsets.values_s - before.values_s
        return {camera: delayed(block, later_s[camera]) for camera, block in blocks.items()}

    def _refine(self) -> None:
        """Do a part of the work that the end of an epoch has left to the frames after it."""
        state, step = self._state, len(self._state.epochs[-1].frames)
        if self._closed.state.findings != state.findings:
            self._closed = ClosedPlaces.of(state)
        if step <= STEPS and len(state.epochs) > 1:
            self._state, self._closed = refine(state, self._closed, step)

    def _assess(self) -> Assessment:
        """Assess the estimates, once: the sums over closed epochs are at hand."""
        state = self._state
        if self._assessed is None or self._assessed[0] is not state:
            before = self._assessed and self._assessed[1].window
            self._assessed = state, assess(state, self._closed, before)
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
            for number, table in since:
                tracker.update(table, frame=number)
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

    def _resume(self, state: State, closed: ClosedPlaces | None = None) -> None:
        """Continue from a state: at the start, at each new epoch, and after an error."""
        self._state = state
        self._epoch_start = state
        self._since_epoch_start = []
        self._rebuild(closed)

    def _rebuild(self, closed: ClosedPlaces | None = None) -> None:
        """Start from the state anew, after anything but a frame has changed it."""
        self._closed, self._assessed = closed or ClosedPlaces.of(self._state), None
        self._state = at_minimum(self._state, self._closed)

    def _restart_after_step(self) -> list[Event]:
        """Restart what has moved so far that frames disagree with the estimate."""
        detected = detect_step(self._state)
        if detected is None:
            return []
        self._state, events = restart_after_step(self._state, detected)
        self._rebuild()
        return list(events)

    def _close_epoch(self) -> list[Event]:
        """Summarize the oldest live epoch, test for a small step, begin another."""
        state, offsets = self._state, self._state.offsets
        if self._assessed is not None:
            state = replace(state, optimum=self._assessed[1].newest(state.optimum))
            offsets = self._assessed[1].offsets(state)
        if offsets is not None:
            state = with_poses(state, follow(state, self._closed.all_sums(state), offsets))
        self._state, events = close_epoch(state, offsets)
        detected = detect_small_step(self._state)
        if detected is not None:
            self._state, more = handle_small_step(self._state, detected)
            events += more
        self._resume(*settle(self._state))
        return events
