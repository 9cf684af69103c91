"""The end of an epoch: the oldest live one is summarized, a new one begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import add

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.solver.camera_block import merge
from calibgraph.tracking.drift import follow_drift, report_drift
from calibgraph.tracking.epoch_summary import step_between
from calibgraph.tracking.events import Event
from calibgraph.tracking.live_frames import Epoch
from calibgraph.tracking.place_shift import shift_between
from calibgraph.tracking.place_sums import PlacePart
from calibgraph.tracking.posterior import true_hessian
from calibgraph.tracking.regate import regate
from calibgraph.tracking.state import CameraState, State, block_diagonal

Array = NDArray[np.float64]


def close_epoch(
    state: State, estimates: Sequence[tuple[gtsam.Pose3, ...]]
) -> tuple[State, list[Event]]:
    """The state with its open epoch closed and a new one begun.

    Args:
        state: before.
        estimates: the newest T_lidar_camera estimates, per live epoch and camera.
    """
    epochs = tuple(
        replace(epoch, T_lidar_camera=of_epoch)
        for epoch, of_epoch in zip(state.epochs, estimates, strict=True)
    )
    state = replace(state, epochs=epochs)
    if len(epochs) > state.config.tracking.live_epochs:
        state = _summarize_oldest(state)
    state = _with_references(state, state.T_lidar_camera)
    cameras = tuple(
        replace(camera_state, scale=camera_state.residuals.scale(state.config))
        if camera_state.started
        else camera_state
        for camera_state in state.cameras
    )
    state = replace(state, cameras=cameras)
    state = regate(state)
    epochs = state.epochs
    epochs = (*epochs[:-1], _with_distortion(state, epochs[-1]), Epoch.empty(state.T_lidar_camera))
    return report_drift(replace(state, epochs=epochs))


def _with_distortion(state: State, epoch: Epoch) -> Epoch:
    """The epoch with the evidence of the scan distortion, if its size is stated."""
    if any(state.findings.bend_sigmas):
        for camera, one in enumerate(state.cameras):
            epoch = epoch.with_distortion(camera, one.scale)
    return epoch


def _with_references(state: State, references: tuple[gtsam.Pose3, ...]) -> State:
    """The state with its sums about other references."""
    steps = np.array([*map(step_between, state.references, references)])
    cameras = tuple(
        replace(camera_state, summary=camera_state.summary.shift_reference(step))
        for camera_state, step in zip(state.cameras, steps, strict=True)
    )
    drift = state.drift
    if drift is not None:
        anchors = zip(drift.anchors, steps, strict=True)
        drift = replace(
            drift, anchors=tuple(anchor.shift_reference(step) for anchor, step in anchors)
        )
    places = state.places.shift_reference(steps)
    epochs = tuple(
        replace(
            epoch,
            frames=tuple(
                replace(f, gradient=f.gradient + np.einsum("nij,nj->ni", f.hessian, steps))
                for f in epoch.frames
            ),
        )
        for epoch in state.epochs
    )
    return replace(
        state,
        cameras=cameras,
        epochs=epochs,
        references=references,
        places=places,
        drift=drift,
    )


@dataclass(frozen=True, eq=False)
class _PlaceInEpoch:
    """Sums of a camera's matches in an epoch at one place, gated anew, about its reference.

    Attributes:
        hessian: (6, 6).
        gradient: (6,) at the reference.
        reweighted: (6, 6) Hessian by the matches' weights in the loss, at the pose of the place.
        pull: (6,) gradient at the reference, from there.
        scores: (f, 6) gradients at the estimate, of all the epoch's frames; zero of others.
        frames, matches: how many.
    """

    hessian: Array
    gradient: Array
    reweighted: Array
    pull: Array
    scores: Array
    frames: int
    matches: int

    @staticmethod
    def empty(frames: int) -> _PlaceInEpoch:
        """Of none of so many frames."""
        zero = np.zeros((6, 6))
        none = np.zeros(6)
        return _PlaceInEpoch(zero, none, zero, none, np.zeros((frames, 6)), 0, 0)

    def __add__(self, other: _PlaceInEpoch) -> _PlaceInEpoch:
        return _PlaceInEpoch(
            self.hessian + other.hessian,
            self.gradient + other.gradient,
            self.reweighted + other.reweighted,
            self.pull + other.pull,
            self.scores + other.scores,
            self.frames + other.frames,
            self.matches + other.matches,
        )


def _sums_at_place(state: State, epoch: Epoch, camera: int, place: str) -> _PlaceInEpoch:
    numbers = np.array([frame.number for frame in epoch.frames])
    nothing = _PlaceInEpoch.empty(len(numbers))
    frames = [f for f in epoch.frames if camera in f.raw and f.place == place]
    if not frames:
        return nothing
    raw = [frame.raw[camera] for frame in frames]
    rows = np.concatenate([frame.inliers[camera] for frame in frames])
    T_lidar_camera, scale = epoch.T_lidar_camera[camera], state.cameras[camera].scale
    residuals = merge(raw).at(to_T_camera_lidar(T_lidar_camera))
    inliers = residuals.block.select(rows)
    block = inliers.with_scale(scale)
    own, starts = np.unique(inliers.frame, return_index=True)
    by_frame = block.frame_sums(T_lidar_camera, np.append(starts, len(inliers.frame)))
    scores = np.zeros((len(numbers), 6))
    scores[np.searchsorted(numbers, own)] = by_frame.gradient
    hessian = true_hessian(residuals, block, scale, T_lidar_camera)
    to_reference = step_between(T_lidar_camera, state.references[camera])
    gradient = by_frame.gradient.sum(axis=0) + hessian @ to_reference
    of_place = None if state.optimum is None else state.optimum.pose_at(place, camera)
    here = block.sums(of_place or T_lidar_camera)
    to_reference = step_between(of_place or T_lidar_camera, state.references[camera])
    pull = here.gradient + hessian @ to_reference
    return _PlaceInEpoch(
        hessian, gradient, here.hessian, pull, scores, len(own), len(inliers.frame)
    )


def _summarize_oldest(state: State) -> State:
    """The state with its oldest epoch added to the summaries."""
    epoch, *younger = state.epochs
    names = tuple(dict.fromkeys(frame.place for frame in epoch.frames))
    cameras = range(len(state.cameras))
    at_places = [
        [_sums_at_place(state, epoch, camera, name) for name in names] for camera in cameras
    ]
    sums = [sum(at, _PlaceInEpoch.empty(len(epoch.frames))) for at in at_places]
    drifted = [one.summary.walk > 0 for one in state.cameras]
    by_places = shift_between(state, (), epoch.frames)
    update_evidence = [
        _update_evidence(state, camera, s, by_places) for camera, s in enumerate(sums)
    ]
    state = replace(state, cameras=tuple(update_evidence))
    state = _select_walks(state)
    gains, summarized = [], []
    for camera, (camera_state, s) in enumerate(zip(state.cameras, sums, strict=True)):
        summary = camera_state.summary
        if s.frames:
            summary = summary.add(s.hessian, s.gradient, s.scores.T @ s.scores, s.frames)
            summary = summary.add_ungated(*_ungated(state, epoch, camera))
        summary, gain = summary.propagate(
            state.walk_variance(len(epoch.frames)), state.overconfidence(camera)
        )
        summarized.append(replace(camera_state, summary=summary))
        gains.append(gain)
    scores = np.hstack([s.scores for s in sums])
    cross, gain = state.cross + _between_cameras(scores), block_diagonal(np.array(gains))
    state = replace(
        state,
        cameras=tuple(summarized),
        cross=gain @ cross @ gain.T,
        epochs=tuple(younger),
        distortion=tuple(map(add, state.distortion, epoch.distortion)),
    )
    parts = [_to_part(name, [at[row] for at in at_places]) for row, name in enumerate(names)]
    return _with_places(state, parts, drifted)


def _ungated(state: State, epoch: Epoch, camera: int) -> tuple[Array, Array]:
    """(6, 6) Hessian and (6,) gradient at the reference, of all matches of a camera in an epoch."""
    pose = epoch.T_lidar_camera[camera]
    raw = merge([frame.raw[camera] for frame in epoch.frames if camera in frame.raw])
    sums = raw.with_scale(state.cameras[camera].scale).sums(pose)
    step = step_between(pose, state.references[camera])
    return sums.hessian, sums.gradient + sums.hessian @ step


def _to_part(name: str, cameras: Sequence[_PlaceInEpoch]) -> PlacePart:
    """The sums of all cameras at one place."""
    return PlacePart(
        name,
        hessian=np.array([one.hessian for one in cameras]),
        gradient=np.array([one.pull for one in cameras]),
        reweighted=np.array([one.reweighted for one in cameras]),
        score=np.array([one.scores.sum(axis=0) for one in cameras]),
        scatter=np.array([one.scores.T @ one.scores for one in cameras]),
        frames=np.array([one.frames for one in cameras], dtype=np.float64),
        matches=np.array([one.matches for one in cameras], dtype=np.float64),
    )


def _with_places(state: State, parts: Sequence[PlacePart], drifted: Sequence[bool]) -> State:
    """The state with an epoch's sums added to those of its places.

    Of a camera that drifts there are only the sums that are discounted by its walk. When the drift
    has ended, what these hold counts as of one place.

    Args:
        state: with the epoch summarized.
        parts: sums of the epoch, per place.
        drifted: per camera, whether it drifted before the epoch was summarized.
    """
    places = state.places.add(parts).bounded()
    for camera, (one, before) in enumerate(zip(state.cameras, drifted, strict=True)):
        if one.summary.walk:
            places = places.without(camera)
        elif before and parts:
            places = places.with_camera_at(
                parts[-1].name, camera, one.summary.selected, state.matches_of_frame(camera)
            )
    return replace(state, places=places)


def _between_cameras(scores: Array) -> Array:
    """(6 n, 6 n) scatter of (f, 6 n) gradients; 0 in the blocks of one camera."""
    scatter: Array = scores.T @ scores
    for rows in range(0, len(scatter), 6):
        scatter[rows : rows + 6, rows : rows + 6] = 0.0
    return scatter


def _update_evidence(
    state: State, camera: int, sums: _PlaceInEpoch, by_places: Array
) -> CameraState:
    """The camera with the evidence of its walks updated by how well they predict an epoch.

    The scatter of epochs is updated here too: by now, a move within the epoch has been detected.
    """
    camera_state, alone = state.cameras[camera], state.scatter_of_frames(camera)
    noise = state.frame_noise(camera)
    if noise is None or alone is None or not sums.frames:
        return camera_state
    score = sums.scores.sum(axis=0)
    groups = tuple(one.add(score, sums.frames, alone) for one in camera_state.groups)
    rows = pose_rows(camera)
    noise = noise * sums.frames + sums.hessian @ by_places[rows, rows] @ sums.hessian
    summary = camera_state.summary.update_evidence(sums.hessian, sums.gradient, noise)
    return replace(camera_state, summary=summary, groups=groups)


def _select_walks(state: State) -> State:
    """The state with each camera's walk selected by the evidence."""
    for camera, camera_state in enumerate(state.cameras):
        summary = camera_state.summary.select_walk()
        if summary.walk > 0 == camera_state.summary.walk:
            state = follow_drift(state, camera, summary.walk)
        else:
            state = state.with_camera(camera, replace(camera_state, summary=summary))
    return state
