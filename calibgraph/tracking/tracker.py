"""Recalibration while the robot drives: one frame in, one estimate out, in constant time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.geometry import to_T_camera_lidar
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Verdict
from calibgraph.solver.camera_block import MIN_MATCHES, CameraBlock, camera_blocks
from calibgraph.solver.preprocess import preprocess
from calibgraph.tracking.assessment import calibration_of, covariance_of, health_of, known_hessian
from calibgraph.tracking.epoch_summary import step_between
from calibgraph.tracking.epochs import closed
from calibgraph.tracking.events import Event, squared_sigmas
from calibgraph.tracking.outlier_frames import agrees, suspect
from calibgraph.tracking.posterior import closed_posterior, quadratic, with_open_epoch
from calibgraph.tracking.start import noted, started
from calibgraph.tracking.state import LiveFrame, State
from calibgraph.tracking.state_bytes import (
    StateError,
    decode,
    encode,
    load_state_file,
    save_state_file,
)
from calibgraph.tracking.step_detection import found_shift, found_step, moved, shifted
from calibgraph.tracking.window import Window

Array = NDArray[np.float64]

_UNSOLVABLE = (RuntimeError, np.linalg.LinAlgError)  # what gtsam and numpy raise
_REMARKS = ("systematic_rotation_rad", "systematic_translation_m")  # that count frame by frame
_SUSPECTS = 20  # frames that are remembered as disagreeing, or as agreeing
_UNUSUAL = 25.0  # squared sigmas of a six-vector
_TOTAL_KEPT = 1 - 1 / 2000  # of the usual scatter, from frame to frame


@dataclass(frozen=True, eq=False)
class Update:
    """What is known after a frame.

    Attributes:
        frame: its number.
        stamp_ns: its time, or that of the last frame that had one, or None.
        T_camera_lidar: per camera, (4, 4): p_camera = T_camera_lidar * p_lidar. The guess, as long
            as the camera has no estimate.
        covariance: per camera, (6, 6) of xi in T_camera_lidar = exp(xi) estimate, xi = (rotation
            [rad], translation [m]) in the camera's axes; None with too few frames to tell.
        verdicts: per camera, whether its estimate can be used now, with reasons.
        events: what happened, found with this frame.
        used: per camera whose matches were absorbed, how many.
        left_out: cameras whose matches disagree with everything known, and were not absorbed.
    """

    frame: int
    stamp_ns: int | None
    T_camera_lidar: dict[str, Array]
    covariance: dict[str, Array | None]
    verdicts: dict[str, Verdict]
    events: tuple[Event, ...]
    used: dict[str, int]
    left_out: tuple[str, ...]


class IncrementalCalibrator:
    """All cameras' extrinsics, kept up to date frame by frame.

    Each frame costs the same, however many came before: live epochs are an iSAM2 problem, older
    ones a summary of constant size. Exact: the two passes per frame, the sum of what frames say,
    and its covariance. Approximate: a summarized epoch is a quadratic about the estimate at the
    time (true Hessian, so the next order is the third), its gate is the one of that time.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        config: settings; the preset ``auto`` if None. ``config.tracking`` is for the tracker.
    """

    _state: State
    _kept: State
    _since: list[tuple[int, Correspondences]]

    def __init__(self, rig: Rig, config: Config | None = None) -> None:
        self._resume(State.initial(rig, config or Config()))

    @property
    def rig(self) -> Rig:
        """The rig with the present estimates."""
        poses = zip(self._state.names, self._state.poses, strict=True)
        return self._state.rig.moved_to({name: to_T_camera_lidar(pose) for name, pose in poses})

    @property
    def initial_rig(self) -> Rig:
        """The rig that it started from."""
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
        """The present estimate as a result of the same type as a batch solve's."""
        return calibration_of(self._state)

    def update(self, table: Correspondences, *, frame: int | None = None) -> Update:
        """Take in one frame: fit, gate, refit; then see whether something moved.

        Args:
            table: the correspondences of one frame, of all cameras that saw something.
            frame: its number, which an empty table does not tell.

        Raises:
            CorrespondenceError: if the table holds several frames, a camera that the rig does not
                have, or a frame that does not come after the last one. Nothing has changed then.
        """
        table = _without_remarks(table)
        number, stamp = self._place_in_time(table, frame)
        matches = self._by_camera(table)
        kept, since = self._kept, list(self._since)
        try:
            self._begin_frame(number, stamp, table)
            return self._take(table, matches)
        except BaseException as error:  # whatever it is: nothing of the frame stays behind
            self._resume(kept)
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
        self._since.append((number, table))
        state = self._state
        state = replace(
            state,
            frame=number,
            stamp_ns=state.stamp_ns if stamp is None else stamp,
            updates=state.updates + 1,
            systematic_sigmas=table.findings.systematic_sigmas
            if len(table)
            else state.systematic_sigmas,
        )
        self._state = _with_open_frame(state, LiveFrame.empty(number, len(state.names)))

    def _take(self, table: Correspondences, matches: dict[int, CameraBlock]) -> Update:
        """Absorb what agrees, set aside what does not, and see what has happened."""
        used = self._absorb(self._sorted(matches))
        events = self._started(table, matches) + self._seen(used) + self._stepped()
        if len(self._state.epochs[-1].frames) >= self._state.config.tracking.epoch_frames:
            events += self._close_epoch()
        return self._report(tuple(events), used)

    def to_bytes(self) -> bytes:
        """Everything that :meth:`from_bytes` needs to go on with the same numbers."""
        return encode((self._kept, tuple(self._since)), self._kept.rig)

    @staticmethod
    def from_bytes(data: bytes) -> IncrementalCalibrator:
        """The tracker that :meth:`to_bytes` has written: its next updates are the same.

        Raises:
            CalibrationError: if the bytes are damaged or of another format.
        """
        state, since = decode(data)
        tracker = IncrementalCalibrator(state.rig, state.config)
        tracker._resume(state)
        for number, table in since:
            tracker.update(table, frame=number)
        return tracker

    def save(self, path: Path | str) -> None:
        """Write the tracker to a file, atomically; :meth:`load` continues from there."""
        save_state_file(Path(path), self.to_bytes())

    @staticmethod
    def load(path: Path | str) -> IncrementalCalibrator:
        """Read a tracker that :meth:`save` has written.

        Raises:
            FileError: if the file is missing, damaged, or not of this format.
        """
        try:
            return IncrementalCalibrator.from_bytes(load_state_file(Path(path)))
        except StateError as error:
            raise FileError(path, f"{error}; track anew from a rig") from error

    def _resume(self, state: State) -> None:
        """Go on from a state: at the start, at each new epoch, and after a restart."""
        self._state = state
        self._kept = state
        self._since = []
        self._rebuild()

    def _rebuild(self) -> None:
        """iSAM2 anew from the state, which something other than a frame has changed."""
        self._window = Window(self._state)
        self._known = known_hessian(self._state)
        self._take_poses()
        self._closed = closed_posterior(self._state)

    def _place_in_time(self, table: Correspondences, frame: int | None) -> tuple[int, int | None]:
        numbers = np.unique(table.frame)
        if len(numbers) > 1:
            raise CorrespondenceError(
                f"an update takes one frame, found {len(numbers)} (from {numbers[0]} to "
                f"{numbers[-1]}); give them one by one"
            )
        if frame is None and not len(numbers):
            raise CorrespondenceError("the table is empty; say which frame it is: frame=...")
        number = int(numbers[0]) if len(numbers) else int(frame or 0)
        if frame is not None and number != frame:
            raise CorrespondenceError(f"the table is of frame {number}, not {frame}", frame=number)
        stamp = int(table.stamp_ns.max()) if table.stamp_ns is not None and len(table) else None
        self._require_after(number, stamp)
        return number, stamp

    def _require_after(self, number: int, stamp: int | None) -> None:
        """Frames come in the order of their numbers, and of their times if they have them."""
        last, last_stamp = self._state.frame, self._state.stamp_ns
        if last is not None and number <= last:
            what = "comes again" if number == last else f"comes after frame {last}"
            raise CorrespondenceError(
                f"frame {number} {what}; frames must be in the order of their numbers: it is left "
                "out",
                frame=number,
            )
        if stamp is not None and last_stamp is not None and stamp <= last_stamp:
            raise CorrespondenceError(
                f"frame {number}: its stamp_ns {stamp} is not after {last_stamp} of the frame "
                "before; mend the clock: it is left out",
                frame=number,
            )

    def _by_camera(self, table: Correspondences) -> dict[int, CameraBlock]:
        """The preprocessed matches of each camera that has enough."""
        if not len(table):
            return {}
        kept = preprocess(self.rig, table, self._state.config)
        matches = camera_blocks(self._state.rig, kept.table, self._state.config)
        return {self._state.names.index(name): found for name, found in matches.items()}

    def _sorted(self, matches: dict[int, CameraBlock]) -> dict[int, CameraBlock]:
        """The matches that agree with the estimate; others are suspects, or have failed."""
        agreeing = {}
        for camera, found in matches.items():
            known = self._state.cameras[camera]
            if not known.started:
                continue
            pose = self._state.poses[camera]
            if agrees(found, pose, known):
                agreeing[camera] = found
            else:
                self._suspect(camera, found)
        return agreeing

    def _suspect(self, camera: int, found: CameraBlock) -> None:
        state = self._state
        known = state.cameras[camera]
        number = state.frame or 0
        own = suspect(
            number,
            found,
            state.poses[camera],
            camera=state.rig.cameras[state.names[camera]],
            known=known,
            config=state.config,
        )
        verdicts = (*known.verdicts, (number, False))[-_SUSPECTS:]
        suspects = known.suspects if own is None else (*known.suspects, own)[-_SUSPECTS:]
        known = replace(known, suspects=suspects, verdicts=verdicts)
        self._state = state.with_camera(
            camera, known.counted(left_out=1, failed=1 if own is None else 0)
        )

    def _absorb(self, agreeing: dict[int, CameraBlock]) -> dict[int, CameraBlock]:
        """The two passes: add, gate with the new estimate, put the gated in place, go on."""
        if not agreeing:
            return {}
        scales = {camera: self._state.cameras[camera].scale for camera in agreeing}
        places = self._window.add({c: m.scaled(scales[c]) for c, m in agreeing.items()})
        gated = {
            c: m.without_outliers(to_T_camera_lidar(self._window.pose(c)), scales[c])
            for c, m in agreeing.items()
        }
        used = {c: m for c, m in gated.items() if len(m.frame) >= MIN_MATCHES}
        self._window.replace(places, {c: m.scaled(scales[c]) for c, m in used.items()})
        self._take_poses()
        open_frame = self._state.epochs[-1].frames[-1]
        for camera, inliers in used.items():
            pose, reference = self._state.poses[camera], self._state.references[camera]
            raw = agreeing[camera]
            sums = quadratic(raw, inliers, scales[camera], pose, reference)
            open_frame = open_frame.plus(camera, raw, inliers, sums)
            self._note(camera, raw, len(inliers.frame))
        self._state = _with_totals(_with_open_frame(self._state, open_frame), open_frame)
        return used

    def _take_poses(self) -> None:
        epochs = self._state.epochs
        poses = tuple(self._window.pose(c) for c in range(len(self._state.names)))
        last = replace(epochs[-1], poses=poses)
        self._state = replace(self._state, epochs=(*epochs[:-1], last))

    def _note(self, camera: int, found: CameraBlock, used: int) -> None:
        """Remember how well a frame agreed."""
        state = self._state
        known = noted(state.cameras[camera], found, state.poses[camera])
        verdicts = (*known.verdicts, (state.frame or 0, True))[-_SUSPECTS:]
        known = replace(known, verdicts=verdicts)
        self._state = state.with_camera(
            camera, known.counted(absorbed=1, given=len(found.frame), used=used)
        )

    def _started(self, table: Correspondences, matches: dict[int, CameraBlock]) -> list[Event]:
        """First estimates of cameras that have none."""
        events = []
        for camera in matches:
            name = self._state.names[camera]
            if self._state.cameras[camera].started:
                continue
            self._state = started(self._state, camera, table)
            if self._state.cameras[camera].started:
                self._rebuild()
                number = self._state.frame or 0
                events.append(Event("started", name, number, number, self._state.stamp_ns))
        return events

    def _seen(self, used: dict[int, CameraBlock]) -> list[Event]:
        """Cameras that have gone blind, or see again."""
        events = []
        state, limit = self._state, self._state.config.tracking.blind_frames
        number = state.frame or 0
        for camera, known in enumerate(state.cameras):
            if not known.started:
                continue
            absent = 0 if camera in used else known.absent + 1
            name = state.names[camera]
            if absent == limit:
                since = self._numbers_ago(limit)
                events.append(Event("blind", name, since, number, state.stamp_ns))
            if absent == 0 and known.absent >= limit:
                events.append(Event("back", name, number, number, state.stamp_ns))
            self._state = self._state.with_camera(camera, replace(known, absent=absent))
        return events

    def _numbers_ago(self, frames: int) -> int:
        """Number of the frame so many frames ago, the last one counted; at least a live one."""
        numbers = [frame.number for frame in self._state.live_frames]
        return numbers[-min(frames, len(numbers))]

    def _stepped(self) -> list[Event]:
        """A step that frames do not agree with any more."""
        found = found_step(self._state)
        if found is None:
            return []
        self._state, events = moved(self._state, found)
        self._rebuild()
        return list(events)

    def _close_epoch(self) -> list[Event]:
        """The oldest live epoch goes into the memory, and iSAM2 begins anew."""
        self._state, events = closed(self._state, self._window.poses())
        shift = found_shift(self._state)
        if shift is not None:
            self._state, told = shifted(self._state, shift)
            events += told
        self._resume(self._state)
        return events

    def _report(self, events: tuple[Event, ...], used: dict[int, CameraBlock]) -> Update:
        state = self._state
        health = health_of(state, with_open_epoch(self._closed, state), self._known)
        names = state.names
        return Update(
            frame=state.frame or 0,
            stamp_ns=state.stamp_ns,
            T_camera_lidar=self.rig.T_camera_lidar,
            covariance=covariance_of(health, names),
            verdicts=health.verdicts,
            events=events,
            used={names[c]: len(m.frame) for c, m in used.items()},
            left_out=tuple(
                name
                for name, known in zip(names, state.cameras, strict=True)
                if known.verdicts[-1:] == ((state.frame, False),)
            ),
        )


def _without_remarks(table: Correspondences) -> Correspondences:
    """The table with only those of its matcher's remarks that hold for a single frame."""
    kept = {key: float(table.metadata[key]) for key in _REMARKS if key in table.metadata}
    return replace(table, metadata=kept)


def _with_open_frame(state: State, frame: LiveFrame) -> State:
    """The state with a frame in its open epoch, in the place of that of the same number."""
    last = state.epochs[-1]
    others = tuple(f for f in last.frames if f.number != frame.number)
    return replace(state, epochs=(*state.epochs[:-1], replace(last, frames=(*others, frame))))


def _with_totals(state: State, frame: LiveFrame) -> State:
    """The state with a frame counted in what frames usually say.

    An unusual frame counts less, for it may come after a move that has not been noticed yet.
    """
    steps = np.array([*map(step_between, state.references, state.poses)])
    scores = frame.gradient + np.einsum("nij,nj->ni", frame.hessian, steps)
    for camera in frame.used:
        noise = state.frame_noise(camera)
        if noise is not None:
            unusual = squared_sigmas(scores[camera], noise)
            scores[camera] *= min(1.0, (_UNUSUAL / unusual) ** 0.5)
    seen = np.array([camera in frame.used for camera in range(len(steps))])
    flat = scores.ravel()
    return replace(
        state,
        total=_TOTAL_KEPT * state.total + np.outer(flat, flat),
        total_hessian=_TOTAL_KEPT * state.total_hessian + frame.hessian,
        total_frames=_TOTAL_KEPT * state.total_frames + seen,
    )
