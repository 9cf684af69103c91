"""Detection of steps: large ones, by frames that disagree, and small ones, by sums of frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import pose_rows
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.cause import alarm_limit, squared_sigmas
from calibgraph.tracking.epoch_sums import sums_before_epochs
from calibgraph.tracking.live_frames import OutlierFrame
from calibgraph.tracking.outlier_frames import agrees
from calibgraph.tracking.state import State
from calibgraph.tracking.steps import shift_since
from calibgraph.tracking.sums import Sums

_PATIENCE = 5  # frames more, until the other cameras show whether they moved too
_OUTVOTE = 2  # outlier frames per frame that still agrees with the old estimate
_LEAST_EPOCHS = 1.0  # summarized, before which the scatter of epochs is unknown
_BEFORE = 20.0  # frames before a small step, at least


@dataclass(frozen=True, eq=False)
class DetectedStep:
    """A step of some cameras.

    Attributes:
        since: number of the first frame after it.
        found_by: the cameras whose frames show it.
        outlier_frames: per camera, the frames set aside that agree on its new place.
    """

    since: int
    found_by: frozenset[int]
    outlier_frames: Mapping[int, tuple[OutlierFrame, ...]] = field(default_factory=dict)


def detect_step(state: State) -> DetectedStep | None:
    """A step so large that frames after it do not agree with the estimate.

    It is accepted when enough outlier frames agree with each other, and every other camera has had
    as many frames to show whether it moved too.
    """
    if not may_have_moved(state):
        return None
    needed = state.config.tracking.step_frames
    clusters = {c: _cluster(camera_state) for c, camera_state in enumerate(state.cameras)}
    found_by = {
        c: near
        for c, near in clusters.items()
        if len(near) >= needed
        and len(near) >= _OUTVOTE * _count_agreeing(state.cameras[c], near[0].number)
    }
    if not found_by:
        return None
    since = min(near[0].number for near in found_by.values())
    longest = max(len(near) for near in found_by.values())
    waiting = any(
        _count_agreeing(camera_state, since) + sum(1 for s in clusters[c] if s.number >= since)
        < needed
        for c, camera_state in enumerate(state.cameras)
        if camera_state.started and camera_state.absent < state.config.tracking.blind_frames
    )
    if waiting and longest < needed + _PATIENCE:
        return None
    return DetectedStep(since, frozenset(found_by), clusters)


def may_have_moved(state: State) -> bool:
    """Whether outlier frames may show a step."""
    needed = state.config.tracking.step_frames
    return any(_has_enough(camera_state, needed) for camera_state in state.cameras)


def _has_enough(camera_state: CameraState, needed: int) -> bool:
    """Whether a cluster of outlier frames may be large enough: if all since its first agree."""
    frames = camera_state.outlier_frames
    return any(
        count >= max(needed, _OUTVOTE * _count_agreeing(camera_state, frames[-count].number))
        for count in range(needed, len(frames) + 1)
    )


def _cluster(camera_state: CameraState) -> tuple[OutlierFrame, ...]:
    """The outlier frames that agree with the newest one; a single one is no evidence."""
    if not camera_state.outlier_frames:
        return ()
    newest = camera_state.outlier_frames[-1]
    near = tuple(
        s for s in camera_state.outlier_frames if agrees(s.raw, newest.T_lidar_camera, camera_state)
    )
    return near if len(near) > 1 else ()


def _count_agreeing(camera_state: CameraState, since: int) -> int:
    """Number of frames since a frame number that agree with the estimate."""
    return sum(1 for number, good in camera_state.agreements if good and number >= since)


def _is_pending(camera_state: CameraState) -> bool:
    """Whether the last frame was an outlier frame, which more may follow."""
    last = camera_state.agreements[-1] if camera_state.agreements else None
    return bool(
        last
        and not last[1]
        and camera_state.outlier_frames
        and camera_state.outlier_frames[-1].number == last[0]
    )


def detect_small_step(state: State) -> DetectedStep | None:
    """A step so small that frames after it still agree with the estimate, at an epoch's start.

    Not while outlier frames may show that it is a large one.
    """
    if any(_is_pending(camera_state) for camera_state in state.cameras):
        return None
    best, detected, tests = 0.0, None, _score_tests(state)
    for row in np.flatnonzero(tests.excess > 0):
        if tests.excess[row] <= best:
            continue  # by what places share it is less still
        epoch, camera = tests.epochs[row], int(tests.cameras[row])
        since, rows = state.epochs[epoch].frames[0].number, pose_rows(camera)
        by_places = tests.hessian[row] @ shift_since(state, since)[rows, rows] @ tests.hessian[row]
        wider = tests.covariance[row] + by_places
        excess = squared_sigmas(tests.score[row], wider) / tests.limits[row] - 1.0
        if excess > best:
            best, detected = excess, DetectedStep(since, frozenset([camera]))
    return detected


@dataclass(frozen=True, eq=False)
class _ScoreTests:
    """Whether a camera's frames before and after the start of an epoch contradict each other.

    Undetermined directions do not count.

    Attributes:
        epochs: (k,) which begin then, by their places among the live ones.
        cameras: (k,) by their places in the rig.
        score: (k, 6) gradient of the frames after, at the minimum of those before.
        covariance: (k, 6, 6) of the score.
        hessian: (k, 6, 6) of the frames after.
        limits: (k,) of the squared sigmas.
    """

    epochs: NDArray[np.int64]
    cameras: NDArray[np.int64]
    score: Array
    covariance: Array
    hessian: Array
    limits: Array

    @cached_property
    def excess(self) -> Array:
        """(k,) of the contradiction, over the limit."""
        sigmas = np.linalg.solve(self.covariance, self.score[..., None])[..., 0]
        return np.asarray((self.score * sigmas).sum(axis=1) / self.limits - 1.0)


def _score_tests(state: State) -> _ScoreTests:
    """Those of all cameras, at the starts of all live epochs but the first."""
    sums = accumulate(epoch.sums for epoch in reversed(state.epochs))
    after = Sums.stack([*sums][::-1])
    before = Sums.stack([*sums_before_epochs(state)])
    ready = [one.started and one.groups[0].count >= _LEAST_EPOCHS for one in state.cameras]
    tested = (before.frames >= _BEFORE) & (after.frames > 0) & np.array(ready)
    tested[0] = False
    tested &= np.array([[len(epoch.frames) > 0] for epoch in state.epochs])
    tested[tested] = before[tested].are_determined
    epochs, cameras = np.nonzero(tested)
    before, after = before[tested], after[tested]
    score, covariance = _scores(before, after)
    covariance = covariance * np.array([*map(state.inflation, cameras.tolist())])[:, None, None]
    limits = np.array([*map(alarm_limit, before.frames)])
    return _ScoreTests(epochs, cameras, score, covariance, after.hessian, limits)


def _scores(before: Sums, after: Sums) -> tuple[Array, Array]:
    """(k, 6) gradients of the frames after, and (k, 6, 6) their covariances by scatter."""
    inverse = np.linalg.inv(before.hessian)
    step = np.linalg.solve(before.hessian, -before.gradient[..., None])
    score = after.gradient + (after.hessian @ step)[..., 0]
    by_estimate = after.hessian @ (inverse @ before.scatter @ inverse) @ after.hessian
    frames = after.frames / (before.frames - 1)
    return score, before.scatter * frames[:, None, None] + by_estimate
