"""The places of a recording: frames that are near each other show the same objects, and err alike.

The motion of a camera from one frame to the next follows from features of its images that both see,
with depths from the cloud: robust PnP, in metres, without odometry.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from calibgraph.io.dataset import Dataset
from calibgraph.io.frame import Frame
from calibgraph.matching.camera_pairs.features import Features, features_of, match_features
from calibgraph.matching.camera_pairs.relative_pose import relative_pose
from calibgraph.matching.camera_pairs.surfaces import planes_at
from calibgraph.model.rig import Camera
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
    places: list[list[int]] = []
    T_now_first, folder = np.eye(4), None
    steps = [None, *motions(dataset, camera, lens, seed=seed)]
    for frame, step in zip(dataset.frames, steps, strict=True):
        T_now_first = T_now_first if step is None else step @ T_now_first
        here = frame.cloud_path.parent
        if here != folder or np.linalg.norm(T_now_first[:3, 3]) > PLACE_M:
            places.append([])
            T_now_first, folder = np.eye(4), here
        places[-1].append(frame.index)
    return places


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
