"""The check of the covariance: solve again and again with frames drawn with replacement."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.model.geometry import twist_between
from calibgraph.model.verdict import Check, above
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.objective import Transforms
from calibgraph.solver.solution import Solution

Array = NDArray[np.float64]

RATIO_WARN, RATIO_FAIL = 2.0, 5.0
"""How many times a bootstrap's standard deviation may be the reported one."""


def bootstrap_covariance(fit: Solution) -> dict[str, Array]:
    """Per camera (6, 6) scatter of xi in T_camera_lidar = exp(xi) solution; empty if not asked for.

    Every draw takes as many frames as there are, with replacement, all cameras of a frame together;
    it is gated and solved like the solution, from there. A draw that leaves a camera with too few
    matches is drawn again.
    """
    resamples = fit.config.bootstrap
    if not resamples or not fit.objective.uses_correspondences:
        return {}
    rng = np.random.default_rng(fit.config.seed)
    numbers = np.unique(np.concatenate([m.frame for m in fit.objective.blocks.values()]))
    draws = [_solved(fit, rng, numbers) for _ in range(resamples)]
    return {
        name: np.atleast_2d(np.cov([twist_between(draw[name], T) for draw in draws], rowvar=False))
        for name, T in fit.T_camera_lidar.items()
    }


def bootstrap_check(reported: Array | None, scattered: Array | None) -> list[Check]:
    """Whether the reported covariance is as large as the bootstrap's.

    Args:
        reported: (6, 6) or None.
        scattered: (6, 6) of the bootstrap, or None if it was not asked for.
    """
    if reported is None or scattered is None:
        return []
    ratio = float(np.sqrt(np.max(np.diag(scattered) / np.diag(reported))))
    return [
        above("bootstrap sigma over reported sigma", ratio, RATIO_WARN, RATIO_FAIL, "",
              "frames disagree more than the error bar says")
    ]  # fmt: skip


_MOST_TRIES = 20


def _solved(fit: Solution, rng: np.random.Generator, numbers: NDArray[np.int64]) -> Transforms:
    """The poses from one draw of frames.

    Raises:
        CorrespondenceError: if no draw has enough matches of every camera.
    """
    for _ in range(_MOST_TRIES):
        drawn = rng.choice(numbers, len(numbers))
        problem = fit.objective.with_blocks(
            {name: _of_frames(m, drawn) for name, m in fit.objective.blocks.items()}
        )
        try:
            poses = problem.without_outliers(fit.T_camera_lidar, fit.scales).minimize(
                fit.T_camera_lidar, fit.scales
            )
            again = problem.without_outliers(poses.T_camera_lidar, fit.scales)
        except CorrespondenceError as error:
            reason = error
            continue
        return again.minimize(poses.T_camera_lidar, fit.scales).T_camera_lidar
    raise CorrespondenceError(f"bootstrap: {reason}; give more frames, or leave --bootstrap out")


def _of_frames(matches: CameraBlock, drawn: NDArray[np.int64]) -> CameraBlock:
    """The matches of some frames, of a frame drawn twice twice."""
    starts = np.searchsorted(matches.frame, drawn)
    ends = np.searchsorted(matches.frame, drawn, side="right")
    rows = np.concatenate([np.arange(a, b) for a, b in zip(starts, ends, strict=True)])
    return matches.select(np.sort(rows))
