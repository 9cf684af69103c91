"""The places of a recording: frames that are near each other show the same objects, and err alike.

The motion of a camera from one frame to the next follows from features of its images that both see,
with depths from the cloud: robust PnP, in metres, without odometry.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CalibrationError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.matching.camera_pairs.features import Features, features_of, match_features
from calibgraph.matching.camera_pairs.relative_pose import relative_pose
from calibgraph.matching.camera_pairs.surfaces import planes_at
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import core_pool

Array = NDArray[np.float64]

PLACE_M = 20.0
"""Frames within so many metres of a place's first frame are of that place: a camera that looks
ahead matches objects at 10 to 50 m."""

Motion = NDArray[np.float64] | None
"""(4, 4) T_later_earlier of the camera; None where the two frames have too little in common."""


def find_places(dataset: Dataset, camera: str, lens: Camera, *, seed: int = 0) -> list[list[int]]:
    """The numbers of the frames of each place, in the order of the frames.

    A frame begins a new place if it is farther than PLACE_M from the first of the place, or of
    another recording. While the motion cannot be found, frames stay at one place, which is the
    cautious side: it widens the error bar. Whoever comes back later is at a new place.

    Args:
        dataset: images and clouds.
        camera: whose images are compared.
        lens: the camera, at its extrinsic.
        seed: of the robust fits.

    Raises:
        FileError: if an image or a cloud cannot be read.
    """
    places: dict[int, list[int]] = {}
    walk, steps = PlaceWalk(), [None, *motions(dataset, camera, lens, seed=seed)]
    for frame, step in zip(dataset.frames, steps, strict=True):
        places.setdefault(walk.first_of_place(frame, step), []).append(frame.index)
    return list(places.values())


class PlaceWalk:
    """The place of one frame after the other."""

    def __init__(self) -> None:
        self._T_now_first, self._folder, self._first = np.eye(4), Path(), -1

    def first_of_place(self, frame: Frame, step: Motion) -> int:
        """The number of the first frame of this frame's place.

        Args:
            frame: the next one.
            step: from the frame before.
        """
        if step is not None:
            self._T_now_first = step @ self._T_now_first
        here = frame.cloud_path.parent
        far = np.linalg.norm(self._T_now_first[:3, 3]) > PLACE_M
        if self._first < 0 or here != self._folder or far:
            self._T_now_first, self._folder, self._first = np.eye(4), here, frame.index
        return self._first


class PlaceFinder:
    """The place of one frame after the other, from their images.

    While the motion is not found by the first camera of the rig, the next ones are tried.

    Args:
        rig: cameras at their extrinsics.
        seed: of the robust fits.
    """

    def __init__(self, rig: Rig, *, seed: int = 0) -> None:
        self._rig, self._seed, self._walk = rig, seed, PlaceWalk()
        self._before: _SeenFrame | None = None

    def first_of_place(self, frame: Frame) -> int:
        """The number of the first frame of this frame's place; see `find_places`.

        A frame whose image or cloud cannot be read is of the place of the one before.
        """
        seen, before = _SeenFrame(frame, {}), self._before
        self._before = seen
        step = None if before is None else self._step(before, seen)
        return self._walk.first_of_place(frame, step)

    def _step(self, before: _SeenFrame, now: _SeenFrame) -> Motion:
        for name, lens in self._rig.cameras.items():
            try:
                earlier = before.frame, before.features(name, lens)
                both = earlier, (now.frame, now.features(name, lens))
                step = _motion(both, lens=lens, seed=self._seed)
            except (CalibrationError, OSError):  # the matcher reports it
                continue
            if step is not None:
                return step
        return None


@dataclass(frozen=True)
class _SeenFrame:
    """A frame, and the features of its images as far as they were wanted."""

    frame: Frame
    found: dict[str, Features | None]

    def features(self, name: str, lens: Camera) -> Features | None:
        """The features of a camera's image."""
        if name not in self.found:
            self.found[name] = _detect(self.frame, name, lens)
        return self.found[name]


def motions(dataset: Dataset, camera: str, lens: Camera, *, seed: int = 0) -> list[Motion]:
    """The motion of a camera from each frame to the next; arguments as of `find_places`."""
    with core_pool() as cores:
        seen = list(cores.map(partial(_detect, camera=camera, lens=lens), dataset.frames))
        step = partial(_motion, lens=lens, seed=seed)
        return list(cores.map(step, pairwise(zip(dataset.frames, seen, strict=True))))


def _detect(frame: Frame, camera: str, lens: Camera) -> Features | None:
    if camera not in frame.image_paths:
        return None
    return features_of(frame, camera, lens)


def _motion(
    both: tuple[tuple[Frame, Features | None], tuple[Frame, Features | None]],
    *,
    lens: Camera,
    seed: int,
) -> Motion:
    """From features of the earlier frame with depth to where the later one sees them."""
    (frame, before), (_, after) = both
    if before is None or after is None:
        return None
    rows = match_features(before, after)
    rays = before.rays[rows[:, 0]]
    cloud = frame.load_cloud()[:, :3].astype(np.float64)
    T = lens.T_camera_lidar
    planes = planes_at(rays, cloud @ T[:3, :3].T + T[:3, 3])
    inverse = np.einsum("ni,ni->n", planes, rays)
    near = inverse > 0  # false where there is no plane
    points = rays[near] / inverse[near, None]
    return relative_pose(points, after.rays[rows[near, 1]], seed=seed)
