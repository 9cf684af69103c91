"""What a change of place looks like: a step of all cameras that is no move.

Frames of one place share errors. So sums over frames before and after some time differ by more than
their scatter, unless they are of the same places.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import adjoint_camera_lidar, pose_rows
from calibgraph.solver.prior_components import pose_covariance
from calibgraph.solver.within_place import WEAK
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.state import State


def shift_since(state: State, number: int) -> Array:
    """(6 n, 6 n) covariance of the steps between frames before a number and those from it on."""
    live = state.live_frames
    before = [frame for frame in live if frame.number < number]
    after = [frame for frame in live if frame.number >= number]
    return shift_between(state, before, after)


def shift_between(state: State, before: Iterable[LiveFrame], after: Iterable[LiveFrame]) -> Array:
    """(6 n, 6 n) covariance of the steps between sets of frames, by what places share.

    Args:
        state: with the older frames, which are added to the first set.
        before: live frames of the first set.
        after: of the second.
    """
    n = len(state.cameras)
    return _shift(state, _counts(before, n), _counts(after, n))


def _shift(state: State, first: dict[str, Array], second: dict[str, Array]) -> Array:
    """(6 n, 6 n) as of :func:`shift_between`, by (n,) numbers of frames per place."""
    n, findings = len(state.cameras), state.findings
    of_cloud = np.square([findings.place_rotation_rad, findings.place_translation_m])
    if not (findings.place_variance or of_cloud.any()):
        return np.zeros((6 * n, 6 * n))
    older = dict(zip(state.places.names, state.places.frames, strict=True))
    names = {**older, **first, **second}
    none = np.zeros(n)
    one = np.array([older.get(name, none) + first.get(name, none) for name in names])
    two = np.array([second.get(name, none) for name in names])
    flat = np.concatenate([*map(adjoint_camera_lidar, state.references)])
    by_cloud = flat @ (state.sizes.cloud * pose_covariance(*of_cloud)) @ flat.T
    of_frame = state.total_hessian / np.maximum(state.total_frames, 1.0)[:, None, None]
    own = np.asarray(findings.place_variance * np.linalg.inv(of_frame + WEAK))
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
    found = np.kron(both, np.ones((6, 6))) * by_cloud
    for camera, covariance in enumerate(own):
        rows = pose_rows(camera)
        found[rows, rows] += both[camera, camera] * covariance
    return np.asarray(found)


def _counts(frames: Iterable[LiveFrame], cameras: int) -> dict[str, Array]:
    """(n,) frames with matches of each camera, per place."""
    found: dict[str, Array] = {}
    for frame in frames:
        counts = found.setdefault(frame.place, np.zeros(cameras))
        for camera in frame.raw:
            counts[camera] += 1
    return found
