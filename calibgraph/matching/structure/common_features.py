"""Co-visible features of a rig's cameras in the frames of a search, and the poses they imply."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import combinations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.camera_pairs.find import Features, features_of, match_features
from calibgraph.matching.camera_pairs.geometry import (
    agree_on_epipolar_geometry,
    points_at,
    relative_pose,
)
from calibgraph.matching.structure.pose_refinement import CameraFrames
from calibgraph.model.rig import Rig

FRAMES = 4


class CommonFeatures:
    """Features that pairs of cameras see in common."""

    def __init__(self, rig: Rig, frames: Mapping[str, CameraFrames], *, seed: int) -> None:
        self._frames, self._seed = frames, seed
        self._matches = dict(_match(rig, frames, seed)) if len(rig.cameras) > 1 else {}

    def place(self, name: str, other: str, T_other_lidar: Array) -> Array | None:
        """(4, 4) T_camera_lidar of a camera from where another one is.

        The clouds give the depths of the features, in the frame of the other camera.

        Returns:
            None if too little is seen in common.
        """
        swap = (other, name) not in self._matches
        pair = (name, other) if swap else (other, name)
        if pair not in self._matches:
            return None
        points, rays = [], []
        for number, *both in self._matches[pair]:
            seen_by_other, seen_by_this = both[::-1] if swap else both
            cloud = self._frames[other].clouds[number].points_lidar_m
            in_other_m = cloud @ T_other_lidar[:3, :3].T + T_other_lidar[:3, 3]
            near, met = points_at(seen_by_other, in_other_m)
            points.append(met)
            rays.append(seen_by_this[near])
        T_this_other = relative_pose(np.concatenate(points), np.concatenate(rays), seed=self._seed)
        return None if T_this_other is None else T_this_other @ T_other_lidar


FrameMatches = tuple[int, Array, Array]
"""Number of the frame, (n, 3) rays of the one camera, (n, 3) of the other."""


def _match(
    rig: Rig, frames: Mapping[str, CameraFrames], seed: int
) -> Iterator[tuple[tuple[str, str], list[FrameMatches]]]:
    """The matches of each pair of cameras that agree on an epipolar geometry."""
    clouds = len(next(iter(frames.values())).clouds)
    numbers = np.unique(np.linspace(0, clouds - 1, FRAMES).round().astype(int)).tolist()
    features = {name: _detect(rig, frames[name], name, numbers) for name in rig.cameras}
    for a, b in combinations(rig.cameras, 2):
        rays = [
            (one.rays[rows[:, 0]], two.rays[rows[:, 1]])
            for one, two in zip(features[a], features[b], strict=True)
            for rows in [match_features(one, two)]
        ]
        sides = [np.concatenate(side) for side in zip(*rays, strict=True)]
        agrees = agree_on_epipolar_geometry(rig.cameras[a], rig.cameras[b], *sides, seed=seed)
        if agrees.any():
            ends = np.cumsum([len(one) for one, _ in rays])[:-1]
            inlier = np.split(agrees, ends)
            yield (
                (a, b),
                [
                    (number, one[kept], two[kept])
                    for number, (one, two), kept in zip(numbers, rays, inlier, strict=True)
                ],
            )


def _detect(rig: Rig, frames: CameraFrames, name: str, numbers: Sequence[int]) -> list[Features]:
    detect = partial(features_of, name=name, camera=rig.cameras[name])
    return list(frames.cores.map(detect, [frames.frames[number] for number in numbers]))
