"""Proposals: poses of a camera that follow from the poses of other cameras of the rig."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from calibgraph.matching.structure.box_search import Box
from calibgraph.matching.structure.epipolar import relative_pose_up_to_scale
from calibgraph.matching.structure.pose_refinement import CameraFrames
from calibgraph.model.geometry import invert, relative_transform
from calibgraph.model.rig import Rig

Array = NDArray[np.float64]

LENGTH_STEP_M = 0.5  # of unknown translations: the refinement reaches half of it
MAX_EXCESS = 0.2  # how far outside of its box a proposal may be, in half-widths


def propose(
    name: str,
    rig: Rig,
    T_camera_lidar: Mapping[str, Array],
    frames: Mapping[str, CameraFrames],
    box: Box,
    *,
    seed: int,
) -> Iterator[Iterable[Array]]:
    """Propose extrinsics of a camera: groups of T_camera_lidar, (4, 4) each.

    In this order: from known relative poses, from features that both cameras see, and from the
    relative poses of the guess. The features leave the length of a translation open, and a pose
    that is right but for this length may be accepted; so all lengths are one group, of which the
    best is to be taken.

    Args:
        name: of the camera.
        rig: lenses, the guess, and the known relative poses.
        T_camera_lidar: (4, 4) of the cameras that have been located.
        frames: of every camera.
        box: in which the camera may be.
        seed: of the epipolar geometry.
    """
    camera = rig.cameras[name]
    for pair in rig.relative_poses:
        if pair.a == name and pair.b in T_camera_lidar:
            yield [pair.T_a_b @ T_camera_lidar[pair.b]]
        elif pair.b == name and pair.a in T_camera_lidar:
            yield [invert(pair.T_a_b) @ T_camera_lidar[pair.a]]
    for other, T_other_lidar in T_camera_lidar.items():
        images = frames[other].features, frames[name].features
        T_this_other = relative_pose_up_to_scale(rig.cameras[other], camera, *images, seed=seed)
        if T_this_other is not None:
            yield _at_lengths(T_this_other, T_other_lidar, box)
    for other, T_other_lidar in T_camera_lidar.items():
        T_guess_other = rig.cameras[other].T_camera_lidar
        yield [relative_transform(camera.T_camera_lidar, T_guess_other) @ T_other_lidar]


def _at_lengths(T_b_a: Array, T_a_lidar: Array, box: Box) -> Iterator[Array]:
    """T_b_lidar in a box, for all lengths of the translation of T_b_a, whose length is unknown."""
    distance_m = np.linalg.norm(relative_transform(T_a_lidar, box.guess_T_camera_lidar)[:3, 3])
    farthest_m = distance_m + np.sqrt(3) * box.translation_m
    for length_m in np.arange(LENGTH_STEP_M / 2, farthest_m + LENGTH_STEP_M, LENGTH_STEP_M):
        T_b_lidar = T_b_a.copy()
        T_b_lidar[:3, 3] *= length_m
        T_b_lidar = T_b_lidar @ T_a_lidar
        if box.excess(box.displacement(T_b_lidar)[None])[0] < MAX_EXCESS:
            yield T_b_lidar
