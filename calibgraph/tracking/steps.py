"""Steps of the cameras between two sets of frames, with their covariance.

Frames of one place share errors. So sums over frames before and after some time differ by more than
their scatter, unless they are of the same places: a change of place looks like a step of all
cameras, and is no move.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import adjoint_camera_lidar, pose_rows
from calibgraph.solver.components import pose_covariance
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.cause import Steps, alarm_limit
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.state import State, block_diagonal
from calibgraph.tracking.sums import Sums

Scatters = Mapping[int, Array]


def steps_between(
    state: State,
    before: tuple[Sums, Scatters],
    after: tuple[Sums, Scatters],
    by_places: Array | None = None,
) -> tuple[Steps, dict[int, Array]]:
    """The steps of all cameras that are determined in both sets of frames.

    Args:
        state: of the tracker.
        before: (n,) sums over the first set; and per camera whose scatter is not as that of all
            frames, the (6, 6) scatter of its gradients.
        after: the same of the second set.
        by_places: (6 n, 6 n) covariance of the steps by what places share.

    Returns:
        The steps; per such camera the step from its reference to where it is after.
    """
    moves = [
        (camera, one, two)
        for camera in range(len(state.cameras))
        if (one := before[0].step(camera)) is not None
        and (two := after[0].step(camera)) is not None
    ]
    cameras = [camera for camera, _, _ in moves]
    rows = np.add.outer(6 * np.array(cameras, dtype=np.intp), np.arange(6)).ravel()
    covariance = np.zeros((len(rows), len(rows)))
    for sums, own in (before, after):
        inverse = block_diagonal(np.asarray(np.linalg.inv(sums.hessian[cameras])))
        covariance += inverse @ _scatter(state, sums.frames, own)[np.ix_(rows, rows)] @ inverse
    inflation = np.repeat([np.sqrt(state.inflation(camera)) for camera in cameras], 6)
    covariance *= np.outer(inflation, inflation)
    if by_places is not None:
        covariance += by_places[np.ix_(rows, rows)]
    limits = np.array([alarm_limit(state.total_frames[camera]) for camera in cameras])
    references = tuple(state.references[camera] for camera in cameras)
    apart = np.ravel([two - one for _, one, two in moves])
    return (
        Steps(tuple(cameras), apart, covariance, limits, references),
        {camera: two for camera, _, two in moves},
    )


def _scatter(state: State, frames: Array, own: Scatters) -> Array:
    """(6 n, 6 n) scatter of the gradients of (n,) numbers of frames, as that of all frames is.

    Args:
        state: of the tracker.
        frames: of each camera.
        own: per camera for which that does not hold, its (6, 6) scatter.
    """
    share = np.repeat(np.sqrt(frames / np.maximum(state.total_frames, 1.0)), 6)
    found = state.total * np.outer(share, share)
    for camera, scatter in own.items():
        rows = pose_rows(camera)
        found[rows], found[:, rows] = 0.0, 0.0
        found[rows, rows] = scatter
    return found


def shift_since(state: State, number: int) -> Array:
    """(6 n, 6 n) covariance of the steps between frames before a number and those from it on."""
    live = state.live_frames
    before = [frame for frame in live if frame.number < number]
    return shift_between(state, before, live[len(before) :])


def shift_between(state: State, before: Iterable[LiveFrame], after: Iterable[LiveFrame]) -> Array:
    """(6 n, 6 n) covariance of the steps between sets of frames, by what places share.

    Args:
        state: with the older frames, which are added to the first set.
        before: live frames of the first set.
        after: of the second.
    """
    n, findings = len(state.cameras), state.findings
    of_cloud = np.square([findings.place_rotation_rad, findings.place_translation_m])
    if not (findings.place_variance or of_cloud.any()):
        return np.zeros((6 * n, 6 * n))
    older = zip(state.places.names, state.places.frames, strict=True)
    counts = {name: np.stack([frames, np.zeros(n)]) for name, frames in older}
    for part, frames in enumerate((before, after)):
        for frame in frames:
            counts.setdefault(frame.place, np.zeros((2, n)))[part, [*frame.raw]] += 1
    flat = np.concatenate([*map(adjoint_camera_lidar, state.references)])
    by_cloud = flat @ (state.sizes.cloud * pose_covariance(*of_cloud)) @ flat.T
    of_frame = state.total_hessian / np.maximum(state.total_frames, 1.0)[:, None, None]
    own = np.asarray(findings.place_variance * np.linalg.inv(of_frame + WEAK))
    one, two = np.stack([*counts.values()], axis=1)
    return shift_covariance(one, two, by_cloud, own)


def shift_covariance(before: Array, after: Array, by_cloud: Array, own: Array) -> Array:
    """(6 n, 6 n) covariance of the steps between two sets of frames by what places share.

    Frames of the same place share their errors, which cancel.

    Args:
        before: (P, n) numbers of frames of the first set, per place and camera.
        after: (P, n) of the second.
        by_cloud: (6 n, 6 n) of all cameras, by the cloud's displacement at a place.
        own: (n, 6, 6) of each camera at a place besides.
    """
    apart = before / np.maximum(before.sum(axis=0), 1.0)
    apart = apart - after / np.maximum(after.sum(axis=0), 1.0)
    both = apart.T @ apart
    of_cameras = block_diagonal(np.diag(both)[:, None, None] * own)
    return np.asarray(np.kron(both, np.ones((6, 6))) * by_cloud + of_cameras)
