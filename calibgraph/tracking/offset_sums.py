"""Sums with the time offset of the camera: from those of poses, and back.

A frame that is taken t later is that of a camera which has moved by t times the twist of the LiDAR:
the seventh column is the product of the others with this twist, which differs from frame to frame.
"""

from __future__ import annotations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.tracking.sums import Sums


def with_offset(sums: Sums, twists_per_s: Array) -> Sums:
    """The sums of frames, with the offset, by (..., 6) twists in the camera's axes."""
    return _mapped(
        sums, np.concatenate([_units(twists_per_s), twists_per_s[..., None, :]], axis=-2)
    )


def without_offset(sums: Sums, information: Array, overconfidence: Array) -> Sums:
    """The sums of the pose, with the offset marginalized.

    Args:
        sums: (...) with the offset.
        information: (...) of the offset at its reference [1/s^2], by other data.
        overconfidence: (...) k of ``calibgraph.tracking.sums``.
    """
    known = information * overconfidence
    gain = sums.hessian[..., :6, 6] / (sums.hessian[..., 6, 6] + known)[..., None]
    found = _mapped(sums, np.concatenate([_units(gain), -gain[..., None]], axis=-1))
    outer = gain[..., :, None] * gain[..., None, :] * known[..., None, None]
    return found.change(
        hessian=found.hessian + outer,
        reweighted=found.reweighted + outer,
        scatter=found.scatter + outer * np.asarray(overconfidence)[..., None, None],
    )


def after_offset_walk(sums: Sums, variance: Array, overconfidence: Array) -> Sums:
    """The sums of places, whose scores are of use, after a walk of the offset alone."""
    by = (variance / overconfidence[..., None])[..., None, :]
    gains = [np.linalg.inv(np.eye(7) + H * by) for H in (sums.hessian, sums.reweighted)]
    reweighted = gains[1] @ sums.reweighted
    return sums.after_walk(variance, overconfidence)[0].change(
        score=(gains[0] @ sums.score[..., None])[..., 0],
        reweighted=(reweighted + reweighted.swapaxes(-1, -2)) / 2,
    )


def _units(alike: Array) -> Array:
    return np.broadcast_to(np.eye(6), (*alike.shape, 6))


def _mapped(sums: Sums, M: Array) -> Sums:
    """The sums whose gradients are (..., e, d) M times these."""
    back = M.swapaxes(-1, -2)
    return Sums.of(
        frames=sums.frames,
        matches=sums.matches,
        hessian=M @ sums.hessian @ back,
        gradient=(M @ sums.gradient[..., None])[..., 0],
        reweighted=M @ sums.reweighted @ back,
        score=(M @ sums.score[..., None])[..., 0],
        scatter=M @ sums.scatter @ back,
    )
