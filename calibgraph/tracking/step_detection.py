"""Detection of steps: large ones, by frames that disagree, and small ones, by sums of frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import accumulate

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import pose_rows
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.cause import alarm_limit, squared_sigmas
from calibgraph.tracking.epoch_sums import sums_before_epochs
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import Epoch, OutlierFrame
from calibgraph.tracking.offset_terms import score_after
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
    best, detected = 0.0, None
    if any(_is_pending(camera_state) for camera_state in state.cameras):
        return None
    sums = [_scattered_as_usual(state, epoch) for epoch in reversed(state.epochs)]
    afterwards = [*accumulate(sums)][::-1]
    befores = sums_before_epochs(state)
    next(befores)
    for epoch, before, after in zip(state.epochs[1:], befores, afterwards[1:], strict=True):
        if not epoch.frames:
            continue
        since = epoch.frames[0].number
        for camera, camera_state in enumerate(state.cameras):
            if not camera_state.started or _shift_excess(state, camera, before, after) <= best:
                continue  # by what places share it is less still
            by_places = shift_since(state, since)
            excess = _shift_excess(state, camera, before, after, by_places=by_places)
            if excess > best:
                best, detected = excess, DetectedStep(since, frozenset([camera]))
    return detected


def _scattered_as_usual(state: State, epoch: Epoch) -> Sums:
    """The (n,) sums of an epoch; with time offsets, scattered as frames about the means of epochs.

    The scatter of its own frames is about the estimate, and so has a step in it.
    """
    if state.offsets is None:
        return epoch.sums
    poses = Sums.stack([one.sums.pose for one in state.epochs])
    left = np.maximum(poses.frames - 1, 0).sum(axis=0)[:, None, None]
    by_camera = poses.scatter_about_mean.sum(axis=0) / np.maximum(left, 1.0)
    frames = [
        changed(f, sums=f.sums.change(scatter=f.sums.frames[:, None, None] * by_camera))
        for f in epoch.frames
    ]
    return epoch.sums_of(frames)


def _shift_excess(
    state: State,
    camera: int,
    before: Sums,
    after: Sums,
    *,
    by_places: Array | None = None,
) -> float:
    """Excess of the contradiction between a camera's frames before and after, over the limit.

    A score test: undetermined directions do not count.
    """
    frames = before.frames[camera]
    known_scatter = state.cameras[camera].groups[0].count >= _LEAST_EPOCHS
    if frames < _BEFORE or not known_scatter or not after.frames[camera]:
        return 0.0
    step = before.pose.step(camera)
    if step is None:
        return 0.0
    hessian, rows = after.hessian[camera, :6, :6], pose_rows(camera)
    if state.offsets is None:
        by_frames = before.scatter[camera] * (after.frames[camera] / (frames - 1))
        by_frames = by_frames + hessian @ before.covariance(camera) @ hessian
        covariance = by_frames * state.inflation(camera)
        score = after.gradient[camera] + hessian @ step
    else:
        score, covariance = score_after(state, camera, before[camera], after[camera])
    if by_places is not None:
        covariance = covariance + hessian @ by_places[rows, rows] @ hessian
    return squared_sigmas(score, covariance) / alarm_limit(frames) - 1.0
