"""What a change of place looks like: a step of all cameras that is no move.

Frames of one place share errors. So sums over frames before and after some time differ by more than
their scatter, unless they are of the same places.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.place_errors import SharedErrors, shift_covariance
from calibgraph.tracking.state import State

Array = NDArray[np.float64]


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
    errors = SharedErrors.of(state.findings, state.references, state.sizes, state.bends.mean)
    if not errors.are_at_places:
        return np.zeros((6 * n, 6 * n))
    first, second = _counts(before, n), _counts(after, n)
    older = dict(zip(state.places.names, state.places.frames, strict=True))
    names = {**older, **first, **second}
    none = np.zeros(n)
    one = np.array([older.get(name, none) + first.get(name, none) for name in names])
    two = np.array([second.get(name, none) for name in names])
    of_frame = state.total_hessian / np.maximum(state.total_frames, 1.0)[:, None, None]
    return shift_covariance(one, two, of_frame, errors)


def _counts(frames: Iterable[LiveFrame], cameras: int) -> dict[str, Array]:
    """(n,) frames with matches of each camera, per place."""
    found: dict[str, Array] = {}
    for frame in frames:
        counts = found.setdefault(frame.place, np.zeros(cameras))
        for camera in frame.raw:
            counts[camera] += 1
    return found
