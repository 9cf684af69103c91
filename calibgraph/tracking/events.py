"""Has something moved? One camera, or the LiDAR under all of them; how far, since when.

If the LiDAR moves by D, every camera shifts by the same D: T_lidar_camera' = D T_lidar_camera, a
tangent step Ad(T_lidar_camera^-1) log(D) in each. One camera's move leaves the others in place.
So the steps of all cameras, with their joint covariance, say which of the two it was.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

Array = NDArray[np.float64]

Kind = Literal["started", "moved", "drifts", "blind", "back"]

ALARM_CHANCE = 1e-8
"""Chance that one test of a camera that has not moved says that it has."""

CLEARLY = 15.0
"""Squared sigmas by which the LiDAR must explain more than any camera alone."""

_POSE = 6


@dataclass(frozen=True)
class Size:
    """How far something moved.

    Attributes:
        rotation_deg: angle.
        translation_cm: length.
        rotation_sigma_deg, translation_sigma_cm: standard deviations along these directions.
    """

    rotation_deg: float
    translation_cm: float
    rotation_sigma_deg: float
    translation_sigma_cm: float

    @staticmethod
    def of(step: Array, covariance: Array) -> Size:
        """The size of a (6,) tangent step with its (6, 6) covariance."""
        rotation, translation = (
            _length_and_sigma(step[rows], covariance[rows, rows])
            for rows in (slice(0, 3), slice(3, 6))
        )
        return Size(
            rotation_deg=float(np.degrees(rotation[0])),
            translation_cm=100 * translation[0],
            rotation_sigma_deg=float(np.degrees(rotation[1])),
            translation_sigma_cm=100 * translation[1],
        )

    def __str__(self) -> str:
        """With units."""
        return (
            f"{self.rotation_deg:.3g} +- {self.rotation_sigma_deg:.2g} deg and "
            f"{self.translation_cm:.3g} +- {self.translation_sigma_cm:.2g} cm"
        )


def _length_and_sigma(step: Array, covariance: Array) -> tuple[float, float]:
    length = float(np.linalg.norm(step))
    direction = step / length if length else np.full(3, 3**-0.5)
    return length, float(np.sqrt(direction @ covariance @ direction))


@dataclass(frozen=True)
class Event:
    """Something that the user should know.

    Attributes:
        kind: ``started``: a camera has its first estimate; ``moved``: it is elsewhere since a
            frame; ``drifts``: it moves slowly, and is followed; ``blind``: no usable matches for
            a while; ``back``: they are there again.
        camera: its name; None: the LiDAR, under all cameras.
        frame: number of the frame since which it is so.
        detected_frame: number of the frame with which it was found.
        stamp_ns: time of that frame, if frames have one.
        size: how far it moved, in the camera's (the LiDAR's) own frame.
    """

    kind: Kind
    camera: str | None
    frame: int
    detected_frame: int
    stamp_ns: int | None = None
    size: Size | None = None

    def __str__(self) -> str:
        """One sentence."""
        who = "the LiDAR" if self.camera is None else f"camera {self.camera!r}"
        text = f"{who} {_SAYS[self.kind]} since frame {self.frame}"
        return text if self.size is None else f"{text}, by {self.size}"


_SAYS: dict[Kind, str] = {
    "started": "has an estimate of its own",
    "moved": "has moved",
    "drifts": "drifts",
    "blind": "has no usable matches",
    "back": "has usable matches again",
}


def alarm_limit(frames: float) -> float:
    """Squared sigmas that a six-vector exceeds by chance with ALARM_CHANCE.

    Its covariance comes from so many frames, so this is Hotelling's distribution, not chi squared.
    """
    freedom = max(frames - _POSE, 4.0)
    quantile = float(fdtri(_POSE, freedom, 1 - ALARM_CHANCE))
    return _POSE * (freedom + _POSE - 1) / freedom * quantile


@dataclass(frozen=True, eq=False)
class Steps:
    """How far each camera seems to have stepped.

    Attributes:
        cameras: those that can tell, by their place in the rig.
        step: (6 n,) tangent steps of T_lidar_camera.
        covariance: (6 n, 6 n).
        limits: (n,) squared sigmas beyond which a camera has moved.
        poses: T_lidar_camera before.
    """

    cameras: tuple[int, ...]
    step: Array
    covariance: Array
    limits: Array
    poses: tuple[gtsam.Pose3, ...]

    def of(self, place: int) -> tuple[Array, Array]:
        """(6,) step and (6, 6) covariance of the camera at that place of ``cameras``."""
        rows = slice(_POSE * place, _POSE * place + _POSE)
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


def cause_of(steps: Steps, sure: Collection[int] = ()) -> Cause:
    """Tell one camera's move from the LiDAR's.

    With a single camera the two are the same; it is then called the camera's.

    Args:
        steps: of all cameras.
        sure: those that have moved for other reasons than their step's size.
    """
    moved = [
        place
        for place, camera in enumerate(steps.cameras)
        if camera in sure or squared_sigmas(*steps.of(place)) > steps.limits[place]
    ]
    alone = Cause(tuple(steps.cameras[place] for place in moved))
    if not moved or len(steps.cameras) == 1:
        return alone
    left, left_by_camera = unexplained(steps)
    if left < _others_limit(steps) and left < left_by_camera - CLEARLY:
        return Cause(steps.cameras, _lidar_step(steps))
    return alone


def unexplained(steps: Steps) -> tuple[float, float]:
    """Squared sigmas that a move of the LiDAR leaves unexplained; and one of the best camera."""
    step, _ = _lidar_step(steps)
    by_lidar = squared_sigmas(steps.step - _by_lidar(steps) @ step, steps.covariance)
    places = range(len(steps.cameras))
    return by_lidar, min(_left_by_camera(steps, place) for place in places)


def _by_lidar(steps: Steps) -> Array:
    """(6 n, 6) steps of all cameras by one of the LiDAR."""
    return np.vstack([pose.inverse().AdjointMap() for pose in steps.poses])


def _lidar_step(steps: Steps) -> tuple[Array, Array]:
    """(6,) log(D) of the LiDAR's move that explains the steps best, and its (6, 6) covariance."""
    design = _by_lidar(steps)
    whitened = np.linalg.solve(steps.covariance, design)
    covariance: Array = np.asarray(np.linalg.inv(design.T @ whitened), dtype=np.float64)
    return covariance @ (whitened.T @ steps.step), covariance


def _left_by_camera(steps: Steps, place: int) -> float:
    """Squared sigmas of all other cameras, which would stand still if only this one moved."""
    rows = np.ones(len(steps.step), dtype=np.bool_)
    rows[_POSE * place : _POSE * place + _POSE] = False
    return squared_sigmas(steps.step[rows], steps.covariance[np.ix_(rows, rows)])


def _others_limit(steps: Steps) -> float:
    """Squared sigmas that one move of the LiDAR may leave unexplained."""
    return float(np.sort(steps.limits)[1:].sum())


def squared_sigmas(step: Array, covariance: Array) -> float:
    """A vector's squared length in units of its covariance."""
    return float(step @ np.linalg.solve(covariance, step))
