"""Slow drift of cameras, or of the LiDAR under all of them: followed at once, reported when clear.

A drift is detected at the first camera that shows it. Whether that camera or the LiDAR drifts is
decided later, when the other cameras have shifted too, or have not. So the summaries of all cameras
are kept as anchors, and the steps from there are tested at every new epoch.
"""

from __future__ import annotations

from calibgraph.tracking.cause import CLEARLY, find_cause, unexplained
from calibgraph.tracking.epoch_summary import EpochSummary
from calibgraph.tracking.epoch_sums import sum_epochs
from calibgraph.tracking.events import Event, Size
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.state import DriftWatch, State
from calibgraph.tracking.steps import steps_between
from calibgraph.tracking.sums import Sums

_QUIET = 1000  # frames in which a drift of the same camera is not reported again
_PATIENCE = 300  # frames until it is reported in any case


def follow_drift(state: State, camera: int, walk: int) -> State:
    """The state with a random walk of a camera, and a watch until it is clear what drifts."""
    camera_state = state.cameras[camera]
    reported_at = camera_state.drift_reported_at
    quiet = reported_at >= 0 and state.updates - reported_at < _QUIET
    if state.drift is None and not quiet:
        anchors = Sums.stack([one.summary.walks[0] for one in state.cameras])
        since = _frames_ago(state, camera_state.summary, walk)
        watch = DriftWatch(camera, state.updates, since, anchors)
        state = changed(state, drift=watch)
    if camera_state.summary.walk:
        return state
    return state.with_camera(
        camera, changed(camera_state, summary=camera_state.summary.with_walk(walk))
    )


def _frames_ago(state: State, summary: EpochSummary, walk: int) -> int:
    """Number of the first frame that the summary of a walk still remembers."""
    oldest = state.live_frames[0].number if state.live_frames else state.frame or 0
    return max(0, oldest - int(summary.walks.frames[walk]))


def report_drift(state: State) -> tuple[State, list[Event]]:
    """The state and the event of a drift, once it is clear what drifts."""
    watch = state.drift
    if watch is None:
        return state, []
    then, now = watch.anchors, sum_epochs(state)
    own, own_now = dict(enumerate(then.scatter)), dict(enumerate(now.scatter))
    steps, _ = steps_between(state, (then, own), (now, own_now))
    if watch.camera not in steps.cameras:
        return changed(state, drift=None), []
    by_lidar, by_camera = unexplained(steps)
    waited = state.updates - watch.begun
    if abs(by_lidar - by_camera) < CLEARLY and waited < _PATIENCE and len(steps.cameras) > 1:
        return state, []
    cause = find_cause(steps, found_by={watch.camera})
    if cause.lidar:
        name, size = None, Size.of(*cause.lidar)
    else:
        name = state.names[watch.camera]
        size = Size.of(*steps.of(steps.cameras.index(watch.camera)))
    event = Event("drifts", name, watch.frame, state.frame or 0, state.stamp_ns, size)
    for camera in range(len(state.cameras)) if cause.lidar else (watch.camera,):
        camera_state = changed(state.cameras[camera], drift_reported_at=state.updates)
        state = state.with_camera(camera, camera_state)
    return changed(state, drift=None).with_moves([event]), [event]
