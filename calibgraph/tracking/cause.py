"""The cause of a step: one camera, or the LiDAR under all of them.

If the LiDAR moves by D, every camera shifts by the same D: T_lidar_camera' = D T_lidar_camera, a
tangent step Ad(T_lidar_camera^-1) log(D) in each. One camera's move leaves the others in place.
So the steps of all cameras, with their joint covariance, distinguish the two.

Frames of a car that stands, or passes the same wall for a while, share errors. Clustering by frames
does not show it, but the sums of epochs do: they scatter more than the scatter of their frames adds
up to. Each is compared with the one before: what lasts longer is a move or a drift, not scatter.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, fdtri

from calibgraph.arrays import Array
from calibgraph.model.geometry import adjoints, pose_rows

ALARM_CHANCE = 1e-8
"""Probability that one test of a camera that has not moved raises an alarm."""

CLEARLY = 15.0
"""Squared sigmas by which the LiDAR must explain more than any camera alone."""

_POSE = 6


def alarm_limit(frames: Array) -> Array:
    """Squared sigmas that a six-vector exceeds by chance with ALARM_CHANCE.

    Its covariance comes from so many frames, so this is Hotelling's distribution, not chi squared.
    """
    freedom = np.maximum(frames - _POSE, 4.0)
    quantile = fdtri(_POSE, freedom, 1 - ALARM_CHANCE)
    return np.asarray(_POSE * (freedom + _POSE - 1) / freedom * quantile)


def chance_limit() -> float:
    """The same of a known covariance: chi squared."""
    return float(chdtri(_POSE, ALARM_CHANCE))


@dataclass(frozen=True, eq=False)
class Steps:
    """The measured step of each camera.

    Attributes:
        cameras: those with an estimate before and after, by their places in the rig.
        step: (6 n,) tangent steps of T_lidar_camera.
        covariance: (6 n, 6 n).
        limits: (n,) squared sigmas beyond which a camera has moved.
        T_camera_lidar: (n, 4, 4) before.
    """

    cameras: tuple[int, ...]
    step: Array
    covariance: Array
    limits: Array
    T_camera_lidar: Array

    @property
    def by_lidar(self) -> Array:
        """(6 n, 6) derivative of all cameras' steps by a step of the LiDAR."""
        return adjoints(self.T_camera_lidar).reshape(-1, _POSE)

    def of(self, camera: int) -> tuple[Array, Array]:
        """(6,) step and (6, 6) covariance of a camera."""
        rows = pose_rows(self.cameras.index(camera))
        return self.step[rows], self.covariance[rows, rows]


@dataclass(frozen=True, eq=False)
class Cause:
    """What moved.

    Attributes:
        cameras: by their places in the rig; empty: nothing.
        lidar: if it was the LiDAR, under all of them: (6,) log(D) in its own frame, and its (6, 6)
            covariance.
    """

    cameras: tuple[int, ...]
    lidar: tuple[Array, Array] | None = None


def find_cause(steps: Steps, found_by: Collection[int] = ()) -> Cause:
    """Decide whether cameras moved, or the LiDAR.

    With a single camera the two cannot be distinguished; the camera is reported.

    Args:
        steps: of all cameras.
        found_by: cameras that have moved, whatever the size of their step.
    """
    moved = (
        camera
        for camera, limit in zip(steps.cameras, steps.limits, strict=True)
        if camera in found_by or squared_sigmas(*steps.of(camera)) > limit
    )
    alone = Cause(tuple(moved))
    if not alone.cameras or len(steps.cameras) == 1:
        return alone
    left, left_by_camera = unexplained(steps)
    of_others = float(np.sort(steps.limits)[1:].sum())
    if left < min(of_others, left_by_camera - CLEARLY):
        return Cause(steps.cameras, _lidar_step(steps))
    return alone


def unexplained(steps: Steps) -> tuple[float, float]:
    """Squared sigmas that are left by a move of the LiDAR, and by one of the best camera."""
    step, _ = _lidar_step(steps)
    by_lidar = squared_sigmas(steps.step - steps.by_lidar @ step, steps.covariance)
    all_rows, by_camera = np.arange(len(steps.step)), []
    for place in range(len(steps.cameras)):  # the steps of all others: zero if it moved alone
        rows = np.delete(all_rows, pose_rows(place))
        by_camera.append(squared_sigmas(steps.step[rows], steps.covariance[np.ix_(rows, rows)]))
    return by_lidar, min(by_camera)


def _lidar_step(steps: Steps) -> tuple[Array, Array]:
    """(6,) log(D) of the LiDAR's move that explains the steps best, and its (6, 6) covariance."""
    design = steps.by_lidar
    whitened = np.linalg.solve(steps.covariance, design)
    covariance: Array = np.asarray(np.linalg.inv(design.T @ whitened), dtype=np.float64)
    return covariance @ (whitened.T @ steps.step), covariance


def squared_sigmas(step: Array, covariance: Array) -> float:
    """A vector's squared length in units of its covariance."""
    return float(step @ np.linalg.solve(covariance, step))


# The scatter of epochs

_KEPT = 0.995  # from epoch to epoch
_UNUSUAL = 30.0  # squared sigmas of a six-vector: an epoch across a move counts for no more


def add_epoch(groups: Array, score: Array, frames: Array, noise: Array) -> Array:
    """(k, 2) number of each camera's epochs, and their squares over their frames' scatter.

    Both are forgotten slowly.

    Args:
        groups: before.
        score: (k, 6) sum of the gradients of an epoch's frames.
        frames: (k,) how many.
        noise: (k, 6, 6) covariance of one frame's.
    """
    whitened = np.linalg.solve(noise, score[..., None])[..., 0]
    squared = (score * whitened).sum(axis=1) / np.maximum(frames, 1.0)
    own = np.minimum(squared, _UNUSUAL) / _POSE
    return np.asarray(_KEPT * groups + np.stack([np.ones(len(own)), own], axis=1))


def inflation(groups: Array) -> Array:
    """(n,) ratio of the epochs' scatter to that of their frames, on average; at least 1.

    For alarms: after few epochs it has little bias.
    """
    return np.asarray(np.maximum(groups[:, 1] / np.maximum(groups[:, 0], 1.0), 1.0))


def sure_inflation(groups: Array) -> Array:
    """(n,) the lower end of the 2-sigma interval of the inflation, for the error bar.

    In place of the inflation itself, a static rig has bars a tenth wider than a batch's.
    """
    sigma = np.sqrt(2 / (_POSE * np.maximum(groups[:, 0], 1.0)))
    return np.asarray(np.maximum(inflation(groups) * (1 - 2 * sigma), 1.0))
