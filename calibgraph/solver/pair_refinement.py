"""What cameras see in common: the last step of the joint solve, and a fit of one pair alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.camera_pairs import Kind, PairTerm, pair_graph, pair_terms
from calibgraph.solver.factor_graph import Optimum, optimize, pose_key
from calibgraph.solver.objective import Objective, Scales

Array = NDArray[np.float64]

_RESCALINGS = 4  # sigmas then change by under 1 % on KITTI
_PAIR_RESCALINGS = 6  # from farther off


def refine_with_pairs(
    inliers: Objective,
    optimum: Optimum,
    scales: Scales,
    matches: CameraMatches,
    *,
    kind: Kind = "surface",
) -> tuple[Objective, Optimum]:
    """Minimize again with the terms of camera pairs: fit, measure their sigmas, gate, fit.

    Args:
        inliers: the objective after the gate of the correspondences.
        optimum: its minimum.
        scales: of the correspondences' residuals.
        matches: with surfaces, taken near the optimum.
        kind: see ``pair_terms``.

    Returns:
        The objective with the pairs' inliers, and its minimum; both unchanged where no pair of
        cameras has enough in common, or the correspondences are not used.
    """
    rig = inliers.rig.moved_to(optimum.T_camera_lidar)
    terms = pair_terms(rig, matches, inliers.config, kind=kind)
    if not terms or not inliers.uses_correspondences:
        return inliers, optimum
    T = optimum.T_camera_lidar
    for _ in range(_RESCALINGS):
        sigmas = [term.sigma_px(T) for term in terms]
        scaled = tuple(t.with_sigma(s) for t, s in zip(terms, sigmas, strict=True))
        T = replace(inliers, pairs=scaled).minimize(T, scales).T_camera_lidar
    kept = tuple(t.without_outliers(T, s) for t, s in zip(scaled, sigmas, strict=True))
    joined = replace(inliers, pairs=kept)
    return joined, joined.minimize(T, scales)


def fit_pair(
    names: tuple[str, str],
    terms: Sequence[PairTerm],
    start: Mapping[str, Array],
    covariance_a: Array,
) -> dict[str, Array]:
    """Both cameras of a pair by what they see in common, the first held near its start.

    Args:
        names: A and B.
        terms: of this pair.
        start: (4, 4) T_camera_lidar of both.
        covariance_a: (6, 6) of the start of A, of xi in T_camera_lidar = exp(xi) start.

    Returns:
        (4, 4) T_camera_lidar of both.
    """
    keys = {name: pose_key(names, name) for name in names}
    # T_camera_lidar = exp(xi) start is T_lidar_camera = start exp(-xi): the same covariance.
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance_a)
    held = gtsam.PriorFactorPose3(keys[names[0]], to_T_lidar_camera(start[names[0]]), noise)
    T = {name: start[name] for name in names}
    for _ in range(_PAIR_RESCALINGS):
        graph = pair_graph([term.with_sigma(term.sigma_px(T)) for term in terms], keys)
        graph.add(held)
        T = optimize(graph, names, T).T_camera_lidar
    return T
