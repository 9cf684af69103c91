"""How many times over correspondences count their information: the weight of relative poses.

The objective takes matches for independent, which they are not. That changes little where matches
alone determine a camera, but a measured relative pose, which states what it knows, would weigh
nothing beside thousands of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import pose_rows
from calibgraph.solver.covariance import frame_gradients, usual_scatter, with_pseudo_frames
from calibgraph.solver.curvature import curvature_at, hessians_of_blocks
from calibgraph.solver.factor_graph import Optimum
from calibgraph.solver.objective import Objective, Scales
from calibgraph.solver.repeats import frames_of_one_place
from calibgraph.solver.shared_error import shared_scatter


def weigh_relative_poses(
    objective: Objective,
    inliers: Objective,
    optimum: Optimum,
    scales: Scales,
    metadata: Mapping[str, Any],
) -> tuple[Objective, Objective, Optimum]:
    """Give measured relative poses their weight beside the correspondences, and minimize again.

    With the paper's presets, and without relative poses or correspondences, nothing changes.

    Args:
        objective: with all correspondences.
        inliers: with those within the gate.
        optimum: of these.
        scales: of the residuals.
        metadata: of the correspondences, with the matcher's error and the places.
    """
    wanted = inliers.config.preset == "auto" and inliers.rig.relative_poses
    if not wanted or not inliers.uses_correspondences:
        return objective, inliers, optimum
    weight = times_counted(inliers, optimum, scales, metadata)
    weighed = inliers.weigh_relative_poses(weight)
    optimum = weighed.minimize(optimum.T_camera_lidar, scales)
    return objective.weigh_relative_poses(weight), weighed, optimum


def times_counted(
    inliers: Objective, optimum: Optimum, scales: Scales, metadata: Mapping[str, Any]
) -> float:
    """The covariance of a camera by its matches, over that if they were independent; at least 1.

    The geometric mean over the six directions and all cameras. Computed for each camera alone.

    Args:
        inliers: of the second pass.
        optimum: its minimum.
        scales: of the residuals.
        metadata: of the correspondences, with the matcher's error and the places.
    """
    alone = inliers.data_only().without_pairs()
    T_camera_lidar = {name: optimum.T_camera_lidar[name] for name in alone.cameras}
    blocks = {name: block.with_scale(scales[name]) for name, block in alone.blocks.items()}
    curvature = curvature_at(alone, T_camera_lidar, hessians_of_blocks(blocks, T_camera_lidar))
    gradients = frame_gradients(alone, T_camera_lidar, scales)
    frames = [float(block.frames) for block in alone.blocks.values()]
    repeats = {
        name: frames_of_one_place(metadata, block.frame_numbers)
        for name, block in alone.blocks.items()
    }
    findings = MatcherFindings.from_metadata(metadata)
    scatter = with_pseudo_frames(
        gradients.T @ gradients,
        curvature.whole,
        np.repeat(frames, 6),
        usual_scatter(alone, T_camera_lidar, curvature),
    ) + shared_scatter(findings, T_camera_lidar, curvature, repeats)
    logarithms = []
    for camera in range(len(frames)):
        rows = pose_rows(camera)
        (sign, size), (_, of_scatter) = (
            np.linalg.slogdet(matrix[rows, rows]) for matrix in (curvature.whole, scatter)
        )
        if sign > 0:
            logarithms.append((of_scatter - size) / 6)
    return max(1.0, float(np.exp(np.mean(logarithms)))) if logarithms else 1.0
