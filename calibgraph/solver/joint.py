"""The joint multi-camera solve: section 3 of the paper in one function."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calibgraph.model.config import TERMS, Config, Terms
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.progress import Stopwatch
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.solver.frame_weights import WeighedCamera, weigh_all_frames
from calibgraph.solver.objective import Objective
from calibgraph.solver.preprocess import preprocess
from calibgraph.solver.solution import Solution
from calibgraph.solver.stage1 import Stage1, T_hat, estimate_stage1
from calibgraph.solver.start import best_start, require_determined


def solve_joint(
    rig: Rig,
    table: Correspondences | Path | str,
    config: Config | None = None,
    terms: Terms = "full",
    *,
    pairwise: Stage1 | None = None,
) -> Solution:
    """The paper's method, from correspondences to the optimum. Nothing is judged.

    Arguments and errors as of :func:`calibgraph.solve`. The pairwise estimates may be given, to
    compare solves of the same correspondences without the PnP of every frame again.
    """
    if terms not in TERMS:
        raise ValueError(f"unknown terms {terms!r}; known are {', '.join(TERMS)}")
    config, watch = config or Config(), Stopwatch()
    with watch("preprocess"):  # 3.4: depth, confidence, grid, cap
        kept = preprocess(rig, table, config)
        require_determined(rig, kept.counts)
    with watch("stage1"):  # 3.3: PnP per frame, median over frames
        pairwise = pairwise or estimate_stage1(rig, kept.table, config)
        blocks = camera_blocks(rig, kept.table, config)
        start = best_start(rig, blocks, pairwise, config, terms)
    weighed: dict[str, WeighedCamera] = {}
    if config.learnt_weights and config.stage1 == "pnp" and terms in ("full", "reprojection"):
        with watch("weights"):  # ours: frames and confidences weighed
            weighed = weigh_all_frames(kept.table, blocks, pairwise, start)
        blocks = {name: camera.block for name, camera in weighed.items()}
        start |= {name: camera.T_camera_lidar for name, camera in weighed.items()}
    objective = Objective(rig, blocks, T_hat(pairwise), config, terms)  # 3.4: Eq. 5
    with watch("pass1"):  # 3.4: two passes: fit,
        rough, scales = objective.minimize_with_scale(start)
    with watch("pass2"):  # drop outliers, fit again
        inliers = objective.without_outliers(rough, scales)
        optimum = inliers.minimize(rough, scales)
    counts = _counts(kept.counts, objective, inliers, pairwise, weighed)
    return Solution(rig, kept.table, objective, inliers, scales, optimum, counts, watch)


def _counts(
    filters: Mapping[str, Mapping[str, int]],
    objective: Objective,
    inliers: Objective,
    pairwise: Stage1,
    weighed: Mapping[str, WeighedCamera],
) -> dict[str, dict[str, int]]:
    """Per camera: correspondences left after each filter and the gate, and its frames."""
    counts = {}
    for name, before in filters.items():
        given, used = (
            part.blocks[name].frame if name in part.blocks else np.empty(0, np.int64)
            for part in (objective, inliers)
        )
        outliers = weighed[name].outlier_frames if name in weighed else 0
        counts[name] = {
            **before,
            "used": len(used),
            "frames": len(np.unique(given)) + outliers,
            "outlier_frames": outliers,
            "frames_used": len(np.unique(used)),
            "frames_without_pnp": pairwise[name].failed_frames if name in pairwise else 0,
        }
    return counts
