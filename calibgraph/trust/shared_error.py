"""The error that all frames share, which the scatter between frames cannot show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows, relative_transform
from calibgraph.solver.camera_pairs import ENOUGH_SURFACES, PairTerm
from calibgraph.solver.curvature import Curvature
from factors import EpipolarBlock, pose_sigmas

Array = NDArray[np.float64]

PAIR_SIGMA_RAD, PAIR_SIGMA_M = np.radians(0.02), 0.004
"""Standard deviation per axis of a relative pose from the images of one scene: the scatter between
the sequences 00, 01, 06 and 07 of KITTI. Errors of lenses and surfaces, which all frames share."""


def shared_covariance(
    findings: MatcherFindings,
    T_camera_lidar: Mapping[str, Array],
    curvature: Curvature | None = None,
    pairs: Sequence[PairTerm] = (),
) -> Array:
    """(6 N, 6 N) covariance of the error that all frames share.

    The matcher displaces the correspondences of cameras that are tied by their images as one rigid
    body, and those of others each by itself. What it does to the solution follows by the curvature:
    also between tied cameras, since a camera that is displaced has wrong ranges for the features in
    common. Between them there is the error of a relative pose from images besides.

    Args:
        findings: the matcher's error.
        T_camera_lidar: the solution, all cameras.
        curvature: there; None if it was solved from the correspondences alone.
        pairs: what cameras see in common, as used in the solution.
    """
    rotation_rad, translation_m = findings.systematic_sigmas
    of_matcher = np.diag(pose_sigmas(rotation_rad=rotation_rad, translation_m=translation_m) ** 2)
    of_pair = np.diag(pose_sigmas(rotation_rad=PAIR_SIGMA_RAD, translation_m=PAIR_SIGMA_M) ** 2)
    cameras = list(T_camera_lidar)
    joint, between = (np.zeros((6 * len(cameras), 6 * len(cameras))) for _ in range(2))
    for body in tied_cameras(cameras, pairs):
        adjoints = _from_first(body, T_camera_lidar)
        for one in body:
            rows = pose_rows(cameras.index(one))
            for two in body:
                columns = pose_rows(cameras.index(two))
                joint[rows, columns] = adjoints[one] @ of_matcher @ adjoints[two].T
            if len(body) > 1:  # half in each of two cameras
                between[rows, rows] += of_pair / 2
    return between + (joint if curvature is None else curvature.response(joint))


def _from_first(body: Sequence[str], T_camera_lidar: Mapping[str, Array]) -> dict[str, Array]:
    """(6, 6) per camera: a twist in the first camera's axes to the same in its own."""
    first = T_camera_lidar[body[0]]
    others = {
        name: gtsam.Pose3(relative_transform(T_camera_lidar[name], first)).AdjointMap()
        for name in body[1:]
    }
    return {body[0]: np.eye(6), **others}


def tied_cameras(cameras: Sequence[str], pairs: Sequence[PairTerm]) -> list[list[str]]:
    """The cameras in groups that are tied by enough common features on surfaces."""
    counts: dict[frozenset[str], int] = {}
    for pair in pairs:
        if not isinstance(pair.block, EpipolarBlock):
            names = frozenset((pair.a, pair.b))
            counts[names] = counts.get(names, 0) + len(pair.frame)
    bodies = [[name] for name in cameras]
    for names, count in counts.items():
        joined = [body for body in bodies if names & set(body)]
        if count >= ENOUGH_SURFACES and len(joined) > 1:
            bodies = [body for body in bodies if body not in joined] + [sum(joined, [])]
    return bodies
