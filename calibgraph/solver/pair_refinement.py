"""The last step of the joint solve: with what cameras see in common."""

from __future__ import annotations

from dataclasses import replace

from calibgraph.model.camera_matches import CameraMatches
from calibgraph.solver.camera_pairs import Kind, pair_terms
from calibgraph.solver.factor_graph import Optimum
from calibgraph.solver.objective import Objective, Scales

_RESCALINGS = 4  # sigmas then change by under 1 % on KITTI


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
