"""The covariance by bootstrap: solve again and again with frames drawn with replacement."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import CorrespondenceError
from calibgraph.model.geometry import twist_between
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.camera_pairs import PairTerm
from calibgraph.solver.objective import Transforms
from calibgraph.solver.solution import Solution

Matches = TypeVar("Matches", CameraBlock, PairTerm)

_MAX_TRIES = 20  # draws in turn that leave a camera with too few matches


def bootstrap_covariance(solution: Solution) -> dict[str, Array]:
    """Per camera (6, 6) scatter of xi in T_camera_lidar = exp(xi) solution.

    Every draw takes as many frames as there are, with replacement, all cameras of a frame together;
    it is gated and solved like the solution, from there. A draw that leaves a camera with too few
    matches is repeated.

    Returns:
        Empty without draws, or where the terms do not use the correspondences.

    Raises:
        CorrespondenceError: if no draw has enough matches of every camera.
    """
    draws = solution.config.bootstrap
    if not draws or not solution.objective.uses_correspondences:
        return {}
    rng = np.random.default_rng(solution.config.seed)
    blocks = solution.objective.blocks.values()
    frames = np.unique(np.concatenate([block.frame for block in blocks]))
    results = [_solve_draw(solution, rng, frames) for _ in range(draws)]
    return {
        name: np.atleast_2d(np.cov([twist_between(r[name], T) for r in results], rowvar=False))
        for name, T in solution.T_camera_lidar.items()
    }


def _solve_draw(
    solution: Solution, rng: np.random.Generator, frames: NDArray[np.int64]
) -> Transforms:
    """The T_camera_lidar of one draw of frames."""
    for _ in range(_MAX_TRIES):
        drawn = rng.choice(frames, len(frames))
        blocks = {name: _draw(b, drawn) for name, b in solution.objective.blocks.items()}
        pairs = [_draw(pair, drawn) for pair in solution.inliers.pairs]
        objective = replace(
            solution.objective, blocks=blocks, pairs=tuple(p for p in pairs if len(p.frame))
        )
        try:
            inliers = objective.without_outliers(solution.T_camera_lidar, solution.scales)
            rough = inliers.minimize(solution.T_camera_lidar, solution.scales).T_camera_lidar
            inliers = objective.without_outliers(rough, solution.scales)
        except CorrespondenceError as error:
            reason = error
            continue
        return inliers.minimize(rough, solution.scales).T_camera_lidar
    raise CorrespondenceError(f"bootstrap: {reason}; give more frames, or leave bootstrap out")


def _draw(block: Matches, drawn: NDArray[np.int64]) -> Matches:
    """The matches of some frames; of a frame that was drawn twice, twice."""
    starts = np.searchsorted(block.frame, drawn)
    ends = np.searchsorted(block.frame, drawn, side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])
    return block.select(np.sort(rows))
