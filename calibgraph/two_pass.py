"""From correspondences to a calibration: the paper's two passes, fit, gate, refit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from calibgraph.assess import assess
from calibgraph.calibration import Calibration
from calibgraph.config import TERMS, Config, Terms
from calibgraph.correspondences import Correspondences
from calibgraph.errors import CorrespondenceError
from calibgraph.graph import pose_graph
from calibgraph.matches import MIN_MATCHES, Matches, matches_by_camera
from calibgraph.preprocess import FILTERS, preprocess
from calibgraph.problem import Clock, Fit, Poses, Problem
from calibgraph.rig import Rig
from calibgraph.stage1 import Stage1, estimate_stage1

Array = NDArray[np.float64]


def solve(
    rig: Rig, table: Correspondences, config: Config | None = None, terms: Terms = "full"
) -> Calibration:
    """Calibrate all cameras of a rig jointly from correspondences.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        table: correspondences; their points are in the LiDAR frame.
        config: settings; the preset ``auto`` if None.
        terms: ``full``; ``reprojection`` (lambda = mu = 0); ``priors`` (no reprojection term);
            ``stage1`` (the aggregated per-frame PnP). The rig's ``relative_poses`` are
            measurements and take part in all but ``stage1``.

    Returns:
        The calibration, with a verdict that says whether it can be used.

    Raises:
        CorrespondenceError: if a camera cannot be determined: fewer than 6 usable correspondences
            and no relative pose that ties it to a camera that has more.
        ValueError: if ``terms`` is unknown.
    """
    return judged(fit(rig, table, config, terms))


def fit(
    rig: Rig, table: Correspondences, config: Config | None = None, terms: Terms = "full"
) -> Fit:
    """The two passes alone, see :func:`solve`; nothing is judged."""
    if terms not in TERMS:
        raise ValueError(f"unknown terms {terms!r}; known are {', '.join(TERMS)}")
    config = config or Config()
    clock = Clock()
    with clock("preprocess"):
        kept = preprocess(rig, table, config)
        _require_determined(rig, kept.counts)
        matches = matches_by_camera(rig, kept.table, config)
    with clock("stage1"):
        stage1 = _stage1(rig, kept.table, config)
        start = _start(rig, matches, stage1.T_camera_lidar, config=config, terms=terms)
    known = pose_graph(rig, stage1.T_camera_lidar, config, terms)
    problem = Problem(tuple(rig.cameras), matches, known, terms)
    with clock("pass1"):
        poses, scales = problem.settled(start, config)
    with clock("pass2"):
        inliers = problem.gated(poses, scales)
        optimum = inliers.minimize(poses, scales)
    return Fit(
        rig=rig,
        metadata=table.metadata,
        systematic_sigmas=table.systematic_sigmas,
        config=config,
        problem=problem,
        inliers=inliers,
        scales=scales,
        optimum=optimum,
        stage1_T_camera_lidar=stage1.T_camera_lidar,
        counts=_counts(kept.counts, problem, inliers, stage1),
        clock=clock,
    )


def judged(fit: Fit, guess: Rig | None = None) -> Calibration:
    """A fit as a result: with what it is worth, and the verdict.

    Args:
        fit: the solution.
        guess: the first guess, if the fit started from a better one.
    """
    guess = guess or fit.rig
    with fit.clock("checks"):
        assessment = assess(fit, guess)
    return Calibration(
        rig=fit.solved_rig,
        initial_rig=guess,
        covariance=assessment.covariance,
        joint_covariance=assessment.joint_covariance,
        camera_verdicts=assessment.verdicts,
        residuals=assessment.residuals,
        counts=fit.counts,
        timings_s=fit.clock.seconds,
        terms=fit.problem.terms,
        config=fit.config,
        stage1_T_camera_lidar=fit.stage1_T_camera_lidar,
        weaknesses=assessment.weaknesses,
        prior_share=assessment.prior_share,
        bootstrap=assessment.bootstrap,
    )


def _require_determined(rig: Rig, counts: Mapping[str, Mapping[str, int]]) -> None:
    """Every camera has enough correspondences, or relative poses tie it to one that has."""
    tied = {name for name, count in counts.items() if count["capped"] >= MIN_MATCHES}
    for _ in rig.cameras:
        tied |= {p.a for p in rig.relative_poses if p.b in tied}
        tied |= {p.b for p in rig.relative_poses if p.a in tied}
    for name, count in counts.items():
        if name not in tied:
            left = ", ".join(f"{count[filter]} {filter}" for filter in FILTERS)
            raise CorrespondenceError(
                f"camera {name!r} has {count['capped']} usable correspondences, at least "
                f"{MIN_MATCHES} are needed, or a relative pose to a camera that has them "
                f"(left after each filter: {left}): {_why_few(count)}",
                camera=name,
            )


def _why_few(count: Mapping[str, int]) -> str:
    """What to do about too few correspondences, by the filter that took them."""
    if count["given"] < MIN_MATCHES:
        return (
            "none or few were found; check that its images show something, that the cloud lies "
            "where T_camera_lidar looks (p_camera = T_camera_lidar * p_lidar), and its name"
        )
    if count["projectable"] < MIN_MATCHES:
        return (
            "the points are not in front of it; check the direction of T_camera_lidar "
            "(p_camera = T_camera_lidar * p_lidar), its axes and its units"
        )
    if count["confident"] < MIN_MATCHES:
        return "their confidence is below confidence_min; lower it if they can be trusted"
    return "they crowd in few cells of the image; match more of it"


def _stage1(rig: Rig, table: Correspondences, config: Config) -> Stage1:
    if config.stage1 == "rig":
        named = [name for name in rig.cameras if name in table.cameras]
        return Stage1({name: rig.cameras[name].T_camera_lidar for name in named}, {}, {})
    return estimate_stage1(rig, table, config)


def _start(
    rig: Rig,
    matches: Mapping[str, Matches],
    T_hat: Mapping[str, Array],
    *,
    config: Config,
    terms: Terms,
) -> Poses:
    """Where the first pass starts.

    Per camera it is the better of Stage 1 and the rig's guess, by the errors of the matches with a
    Cauchy loss of the PnP's threshold; with the terms ``stage1``, Stage 1 itself. Cameras
    without matches start where a relative pose puts them.
    """
    start = {}
    for name in matches:
        if terms == "stage1" and name not in T_hat:
            raise CorrespondenceError(
                f"camera {name!r}: PnP failed in every frame, so there is no Stage-1 estimate; "
                "solve with other terms, or give more matches per frame",
                camera=name,
            )
        candidates = [T_hat[name]] if name in T_hat else []
        if terms != "stage1":
            candidates.append(rig.cameras[name].T_camera_lidar)
        errors = [matches[name].errors_px(T)[0] / config.pnp_threshold_px for T in candidates]
        costs = [float(np.mean(np.log1p(e**2))) for e in errors]
        start[name] = candidates[int(np.argmin(costs))]
    for _ in rig.cameras:
        for pair in rig.relative_poses:
            if pair.b in start:
                start.setdefault(pair.a, pair.T_a_b @ start[pair.b])
            if pair.a in start:
                start.setdefault(pair.b, np.linalg.inv(pair.T_a_b) @ start[pair.a])
    return {name: start[name] for name in rig.cameras}


def _counts(
    filters: Mapping[str, Mapping[str, int]], problem: Problem, inliers: Problem, stage1: Stage1
) -> dict[str, dict[str, int]]:
    """Per camera: correspondences left after each filter and the gate, and its frames."""
    counts = {}
    for name, before in filters.items():
        given, used = (
            p.matches[name].frame if name in p.matches else np.empty(0, np.int64)
            for p in (problem, inliers)
        )
        counts[name] = {
            **before,
            "used": len(used),
            "frames": len(np.unique(given)),
            "frames_used": len(np.unique(used)),
            "frames_without_pnp": stage1.failed_frames.get(name, 0),
        }
    return counts
