"""Recalibration while the robot drives: frames in, an estimate out, in constant time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.files import require_file, write_bytes
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.rig import Rig
from calibgraph.simulation.correspondences import simulate_correspondences
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.matches import MIN_MATCHES, CameraBlock, camera_block
from calibgraph.solver.preprocess import (
    are_projectable,
    best_in_cell,
    camera_numbers,
    number_repeats,
    within_cap,
)
from calibgraph.tracking.absorption import (
    absorb,
    begin_frames,
    count_absent,
    count_repeats,
    select_agreeing,
    start_cameras,
)
from calibgraph.tracking.assessment import Update, make_updates, to_calibration
from calibgraph.tracking.epochs import close_epoch
from calibgraph.tracking.estimate import EpochGraph, Estimate, settle
from calibgraph.tracking.events import Event
from calibgraph.tracking.frames import StreamFrame, frame_of, prepared, repeated_cameras
from calibgraph.tracking.gate import Gated
from calibgraph.tracking.moves import (
    detect_small_step,
    detect_step,
    handle_small_step,
    restart_after_step,
)
from calibgraph.tracking.state import State
from calibgraph.tracking.state_bytes import StateError, decode, encode

UNSOLVABLE = (RuntimeError, np.linalg.LinAlgError)  # what gtsam and numpy raise
Taken = tuple[StreamFrame, list[Event], Mapping[int, int]]
"""A frame, the events detected with it, and of cameras that were used how many matches."""
Outcome = list[Update] | CorrespondenceError
"""Updates of frames that were taken in at once, or why one frame is left out."""


class IncrementalCalibrator:
    """All cameras' extrinsics, updated frame by frame.

    Each frame costs the same, however many came before: live epochs keep their matches, for a new
    gate; all frames are a quadratic per camera and place about the estimate at the begin of the
    epoch (true Hessian, so the next order is the third). All else is as in a batch.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        config: settings; the preset ``auto`` if None. ``config.tracking`` is for the tracker.
    """

    def __init__(self, rig: Rig, config: Config | None = None) -> None:
        self._state = State.initial(rig, config or Config())
        self._graph: EpochGraph | None = None
        self._estimate: Estimate | None = None

    @property
    def rig(self) -> Rig:
        """The rig with the present estimates."""
        return self._state.rig_at(self._present().T_camera_lidar)

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

    def calibration(self) -> Calibration:
        """The present estimate as a batch's result."""
        return to_calibration(self._state, self._present())

    def _present(self) -> Estimate:
        self._estimate = self._estimate or self._graph_of(self._state).solve(self._state)
        return self._estimate

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
        return self.update_together([frame_of(table, frame, place)])[0]

    def update_all(self, frames: Sequence[StreamFrame]) -> Iterator[Outcome]:
        """Take in frames, together where nothing is unusual; what became of them, in order."""
        while frames:
            try:
                updates = self.update_together(frames)
            except CorrespondenceError as error:
                yield error
                frames = frames[1:]
            else:
                yield updates
                frames = frames[len(updates) :]

    def update_together(self, frames: Sequence[StreamFrame]) -> list[Update]:
        """Take in the first of some frames at once: of what is unusual, one alone.

        At most up to the end of an epoch. All their updates have the estimate after the last of
        them, which is as of one by one.

        Args:
            frames: in the order of their numbers, at least one.

        Raises:
            CorrespondenceError: if the first cannot be taken in, as of :meth:`update`.
        """
        group, state = self._alike(frames), self._state.draft()
        try:
            taken = self._take_in(state, group)
            estimate = self._solve(state)
            updates = make_updates(state, estimate, taken)
        except BaseException as error:
            self._graph = self._estimate = None
            if isinstance(error, UNSOLVABLE):
                number, why = group[0].frame, str(error).strip().splitlines()[0]
                raise CorrespondenceError(
                    f"frame {number}: with its matches the estimate cannot be solved for ({why}); "
                    "it is left out",
                    frame=number,
                ) from error
            raise
        self._state, self._estimate = state, estimate
        return updates

    def _alike(self, frames: Sequence[StreamFrame]) -> list[StreamFrame]:
        """The first frames, up to the end of the epoch, that state the same of their errors.

        None but the first repeats a frame of before: a camera may have its first matches in any of
        them.
        """
        state = self._state
        group = [prepared(state, frames[0], state.frame)]
        room = state.config.tracking.epoch_frames - state.sizes[-1]
        for frame in frames[1:room]:
            try:
                one = prepared(state, frame, group[-1].frame)
            except CorrespondenceError:
                break
            if not {*one.table.cameras, *group[0].table.cameras} <= {*state.names}:
                break
            if _columns(group[0].table) != _columns(one.table):
                break
            group.append(one)
        if group[1:] and any(repeated_cameras(state, one.table) for one in group):
            return group[:1]
        return group

    def _take_in(self, state: State, group: Sequence[StreamFrame]) -> list[Taken]:
        """Absorb the matches that agree, set aside the others, detect events.

        Of half the frames, while one of them disagrees or a camera may start.
        """
        group, table, repeated, blocks = _preprocessed(state, group, self._graph_of(state).rig)
        gated = {
            camera: Gated.at(state.references[camera], block, state.scales[camera])
            for camera, block in blocks.items()
            if state.started[camera]
        }
        usual = gated.keys() == blocks.keys()  # no camera may start
        usual = usual and all(one.agrees(state.share[camera]) for camera, one in gated.items())
        if not usual and group[1:]:
            return self._take_in(state, group[: len(group) // 2])
        begin_frames(state, group)
        if not usual:
            gated = select_agreeing(state, self._graph_of(state), gated)
        absorb(state, gated)
        used, events = state.sums.matches[-len(group) :], list[Event]()
        if not usual:
            events = start_cameras(state, table, blocks)
        taken = list[Taken]()
        for one, counts in zip(group, used.tolist(), strict=True):
            own = {camera: int(count) for camera, count in enumerate(counts) if count}
            count_repeats(state, one.table, repeated)
            taken.append((one, events + count_absent(state, own, one), own))
            events = []
        detected = None if usual else detect_step(state)
        if detected is not None:  # moved so far that frames disagree with the estimate
            taken[-1][1].extend(restart_after_step(state, detected))
        if state.sizes[-1] >= state.config.tracking.epoch_frames:  # begin another one
            taken[-1][1].extend(close_epoch(state, self._graph_of(state)))
            detected = detect_small_step(state)
            if detected is not None:
                taken[-1][1].extend(handle_small_step(state, detected))
            self._graph = settle(state)
        return taken

    def _solve(self, state: State) -> Estimate:
        """The optimum and marginal, without relative poses that contradict the correspondences."""
        estimate = self._graph_of(state).solve(state)
        if estimate.contradicting != state.contradicting:
            state.contradicting = estimate.contradicting
            estimate = self._graph_of(state).solve(state)
        return estimate

    def _graph_of(self, state: State) -> EpochGraph:
        """The graph of the epoch of a state."""
        if self._graph is None or not self._graph.is_of(state):
            self._graph = EpochGraph(state)
        return self._graph

    def to_bytes(self) -> bytes:
        """The tracker as bytes, from which :meth:`from_bytes` continues with the same numbers."""
        return encode(self._state)

    @staticmethod
    def from_bytes(data: bytes) -> IncrementalCalibrator:
        """The tracker that :meth:`to_bytes` has written: its next updates are the same.

        Raises:
            CalibrationError: if the bytes are damaged or of another format.
        """
        state = decode(data, State)
        tracker = IncrementalCalibrator(state.rig, state.config)
        tracker._state = state
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


def _columns(table: Correspondences) -> tuple[object, ...]:
    optional = table.information_px, table.twist_per_s, table.late_s
    return len(table) > 0, table.findings, *(column is None for column in optional)


def _preprocessed(
    state: State, group: Sequence[StreamFrame], rig: Rig
) -> tuple[Sequence[StreamFrame], Correspondences, list[int], dict[int, CameraBlock]]:
    """Frames that can be taken in at once; their matches as given, and preprocessed by camera.

    The first alone, where one of them repeats another one; without the cameras of its table that
    repeat themselves, whose numbers are in between.

    Args:
        state: of the tracker.
        group: the frames.
        rig: at the estimates.
    """
    table, found = group[0].table, dict[int, CameraBlock]()
    repeated = repeated_cameras(state, table) if len(group) == 1 else []
    if repeated:
        table = table.select(~np.isin(table.camera_index, repeated))
    elif len(group) > 1:
        table = concatenate([one.table for one in group])
    if not len(table):
        return group, table, repeated, found
    config, cameras = state.config, [*state.rig.cameras.values()]
    usable = table.without_cameras(config.excluded_cameras) if config.excluded_cameras else table
    numbers = camera_numbers(rig, usable)
    confident = are_projectable(rig, usable, numbers) & (usable.confidence >= config.confidence_min)
    rows = best_in_cell(rig, usable, numbers, config, among=confident)
    numbers = numbers[rows]
    if len(group) > 1:
        kept = usable.select(rows)
        if not np.array_equal(number_repeats(kept, numbers), kept.frame):
            return _preprocessed(state, group[:1], rig)
    if len(rows) > config.matches_max:
        capped = within_cap(usable.select(rows), numbers, config)
        rows, numbers = (rows, numbers) if capped is None else (rows[capped], numbers[capped])
    edges = np.searchsorted(numbers, np.arange(len(cameras) + 1)).tolist()
    for camera, (first, end) in enumerate(pairwise(edges)):
        if end - first >= MIN_MATCHES:
            block = camera_block(cameras[camera], usable.select(rows[first:end]), config)
            enough = block.frame_counts >= MIN_MATCHES
            if enough.all():
                found[camera] = block
            elif enough.any():
                found[camera] = block.select(np.repeat(enough, block.frame_counts))
    return group, table, repeated, found


_FRAMES, _MATCHES = 24, 250  # enough to start a camera, close two epochs and fill a large block


def warm_up_tracker() -> None:
    """Load the compiled code of updates (in a fresh install: compile it), by a drive of its own.

    Otherwise the first updates wait for it: for 0.3 s, and in a fresh install for seconds.
    """
    rig = rig_of("kitti")
    tracker = IncrementalCalibrator(rig)
    table = simulate_correspondences(rig, frames=_FRAMES, matches=_MATCHES)
    for frame in range(_FRAMES):
        tracker.update(table.select(table.frame == frame), frame=frame)
