"""The places of a recording: frames that are near each other show the same objects, and err alike.

The motion from one frame to the next follows from poses of the LiDAR, if they are given, or from
its twists over a short time; else from features of a camera's images that both see, with depths
from the cloud: robust PnP, in metres; or from the two clouds. Who returns to a place, in any
direction, is recognised by the cloud of the place's first frame. Clouds are compared upright.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, DatasetError
from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame, seconds_between
from calibgraph.matching.camera_pairs.find import Features, features_of, match_features
from calibgraph.matching.camera_pairs.geometry import points_at, relative_pose
from calibgraph.matching.cloud_similarity import (
    LEAST_UPRIGHT,
    Z_UP,
    UprightCloud,
    align_with_any,
    find_up,
)
from calibgraph.model.geometry import invert, transform
from calibgraph.model.rig import Camera, Rig
from calibgraph.parallel import core_pool

PLACE_M = 20.0
"""Radius [m] of a place about its first frame: a camera that looks
ahead matches objects at 10 to 50 m."""

MOST_S = 1.0
"""Longest time over which twists are integrated: from the mean of those at both ends the distance
differs by up to a t^2 / 4, which is 0.75 m at 3 m/s^2."""

Motion = NDArray[np.float64] | None
"""(4, 4) T_later_earlier of the LiDAR; None where the two frames have too little in common."""

UNKNOWN_UP = (
    "which way is up in the clouds is unknown, so that they are not compared: all frames are taken "
    "to be of one place"
)


def find_places(dataset: Dataset, rig: Rig, camera: str, *, seed: int = 0) -> list[list[int]]:
    """The numbers of the frames of each place, in the order of the frames.

    Args:
        dataset: the frames.
        rig: cameras at their extrinsics.
        camera: whose images show the motion.
        seed: of the robust fits.

    Without poses and twists, features show the motion up to some 5 m, and clouds beyond. A frame
    farther than PLACE_M from the first of its place, of another recording, or after an unknown
    motion, is compared with the first frames of all places. It joins the most similar place within
    PLACE_M, or begins a new one. Unlike clouds show another place only if enough stands upright in
    both: else a frame after an unknown motion stays at the place before.

    Raises:
        FileError: if an image or a cloud cannot be read.
    """
    places: dict[int, list[int]] = {}
    steps = [None, *motions(dataset, camera, rig.cameras[camera], seed=seed)]
    walk = PlaceWalk(rig)
    for frame, step in zip(dataset.frames, steps, strict=True):
        places.setdefault(walk.first_of_place(frame, step), []).append(frame.index)
    return list(places.values())


class PlaceWalk:
    """The place of one frame after the other.

    Args:
        rig: whose cameras show which way is up in the clouds; None where z is.
    """

    def __init__(self, rig: Rig | None = None) -> None:
        self._T_now_first, self._first = np.eye(4), -1
        self._before: Frame | None = None
        self._known: dict[int, UprightCloud] = {}  # by their first frames
        self._rig = rig
        self._R_up_lidar: Array | None = Z_UP  # once the rig is None

    def first_of_place(self, frame: Frame, step: Motion) -> int:
        """The number of the first frame of this frame's place."""
        before, self._before = self._before, frame
        if before is None or before.cloud_path.parent != frame.cloud_path.parent:
            self._find_place(frame)
            return self._first
        if step is None:
            earlier, later = (self._upright_cloud(each) for each in (before, frame))
            found = earlier and later and self._align(later, [earlier])
            step = found[1] if found else None
            if step is None:  # unless enough stands upright in both, nothing shows another place
                unlike = all(
                    each and len(each.points_m) >= LEAST_UPRIGHT for each in (earlier, later)
                )
                self._find_place(frame, may_stay=not unlike)
                return self._first
        self._T_now_first = step @ self._T_now_first
        if _distance_m(self._T_now_first) > PLACE_M:
            self._find_place(frame, left=self._first)
        return self._first

    def _find_place(self, frame: Frame, *, left: int | None = None, may_stay: bool = False) -> None:
        """The most similar known place but for one that was left, else the present or a new one."""
        cloud = self._upright_cloud(frame)
        known = [first for first in self._known if first != left]
        found = cloud and self._align(cloud, [self._known[first] for first in known])
        if found and _distance_m(found[1]) <= PLACE_M:
            self._first, self._T_now_first = known[found[0]], found[1]
            self._visit(self._first, self._known[self._first])
        elif self._first < 0 or not (may_stay or self._R_up_lidar is None) or found:
            self._first, self._T_now_first = frame.index, np.eye(4)
            self._visit(frame.index, cloud)

    def _visit(self, first: int, cloud: UprightCloud | None) -> None:
        self._known.pop(first, None)
        if cloud is not None:
            self._known[first] = cloud

    def _align(self, now: UprightCloud, known: Sequence[UprightCloud]) -> tuple[int, Array] | None:
        """As of :func:`align_with_any`, in the axes of the LiDAR."""
        found = align_with_any(now, known)
        if found is None or self._R_up_lidar is None:
            return None
        T_up_lidar = transform(self._R_up_lidar)
        return found[0], invert(T_up_lidar) @ found[1] @ T_up_lidar

    def _upright_cloud(self, frame: Frame) -> UprightCloud | None:
        """The upright structure of a frame's cloud; None where up is unknown, or if unreadable.

        The matcher reports clouds that cannot be read.
        """
        try:
            if self._rig is not None:
                self._R_up_lidar = find_up(frame.load_cloud(), self._rig.T_camera_lidar.values())
                self._rig = None
            R = self._R_up_lidar
            if R is None:
                return None
            key = ("upright", R.tobytes())
            return frame.derive(key, lambda: UprightCloud.from_cloud(frame.load_cloud(), R))
        except (CalibrationError, OSError):
            return None


def _given_motion(before: Frame, now: Frame) -> Motion:
    """The motion by the poses of both frames, or by their twists if they are close in time.

    None if one cannot be found, which the matcher reports.
    """
    try:
        one, two = before.T_world_lidar, now.T_world_lidar
        if one is not None and two is not None:
            return invert(two) @ one
        seconds = seconds_between(before, now)
        if seconds is None or abs(seconds) > MOST_S:
            return None
        twists = before.twist_per_s, now.twist_per_s
    except (CalibrationError, OSError):
        return None
    if twists[0] is None or twists[1] is None:
        return None
    return np.asarray(gtsam.Pose3.Expmap(-seconds * (twists[0] + twists[1]) / 2).matrix())


def _distance_m(T: Array) -> float:
    return float(np.linalg.norm(T[:3, 3]))


def motions(dataset: Dataset, camera: str, lens: Camera, *, seed: int = 0) -> list[Motion]:
    """The motion from each frame to the next; arguments as of `find_places`."""
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
    """As given, else by the earlier frame's features that have depth and the later one's pixels."""
    (frame, before), (later, after) = both
    given = _given_motion(frame, later)
    if given is not None or before is None or after is None:
        return given
    try:
        cloud = frame.load_cloud()[:, :3].astype(np.float64)
    except DatasetError:  # it is to be corrected for a motion that cannot be found
        return None
    rows = match_features(before, after)
    T = lens.T_camera_lidar
    near, points = points_at(before["ray"][rows[:, 0]], cloud @ T[:3, :3].T + T[:3, 3])
    T_later_earlier = relative_pose(points, after["ray"][rows[near, 1]], seed=seed)
    return None if T_later_earlier is None else invert(T) @ T_later_earlier @ T
