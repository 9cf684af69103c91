"""The error that all frames of a recording share, beside the sandwich of the paper's presets.

With the preset ``auto`` it is part of ``calibgraph.solver.error_model``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.camera_pairs import PairTerm
from calibgraph.solver.curvature import Curvature
from calibgraph.solver.pair_refinement import pair_sigmas
from factors import pose_sigmas

Array = NDArray[np.float64]

def shared_scatter(
    findings: MatcherFindings,
    T_camera_lidar: Mapping[str, Array],
    curvature: Curvature,
    repeats: Mapping[str, float],
) -> Array:
    """(6 N, 6 N) covariance of the gradient, by the error that all frames share.

    Three parts. The cloud is displaced as a rigid body, for all cameras alike, and the matches of
    each camera are displaced by themselves: each with half the variance of ``systematic_sigmas``.
    And frames of one place show the same objects, so that a part of their error repeats: as
    ``place_variance`` times the covariance of one frame's matches, if they were independent. Their
    scatter, in which this part is missing, is added elsewhere.

    Args:
        findings: the matcher's error.
        T_camera_lidar: the solution, all cameras.
        curvature: there.
        repeats: per camera with correspondences, how many frames share a place, in the mean.
    """
    rotation_rad, translation_m = findings.systematic_sigmas
    half = np.diag(pose_sigmas(rotation_rad=rotation_rad, translation_m=translation_m) ** 2) / 2
    cameras = list(T_camera_lidar)
    to_cameras = np.concatenate([gtsam.Pose3(T).AdjointMap() for T in T_camera_lidar.values()])
    displaced = to_cameras @ half @ to_cameras.T + np.kron(np.eye(len(cameras)), half)
    matches = curvature.of_correspondences
    scatter = np.asarray(matches @ displaced @ matches)
    for name, repeated in repeats.items():
        rows = pose_rows(cameras.index(name))
        scatter[rows, rows] += findings.place_variance * repeated * matches[rows, rows]
    return scatter


def error_between(T_camera_lidar: Mapping[str, Array], pairs: Sequence[PairTerm]) -> Array:
    """(6 N, 6 N) covariance of the error of relative poses from images, half in each camera."""
    of_pair = np.diag(pair_sigmas() ** 2)
    seen = {name for pair in pairs for name in (pair.a, pair.b)}
    cameras = np.diag([float(name in seen) for name in T_camera_lidar])
    return np.asarray(np.kron(cameras, of_pair / 2))
