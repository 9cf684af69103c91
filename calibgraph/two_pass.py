"""From correspondences to a calibration: the paper's two passes, fit, gate, refit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.assess import assess
from calibgraph.calibration import Calibration
from calibgraph.config import TERMS, Config, Terms
from calibgraph.correspondences import Correspondences
from calibgraph.errors import CorrespondenceError
from calibgraph.graph import pose_graph
from calibgraph.learnt_weights import Weighed, learn_weights
from calibgraph.matches import MIN_MATCHES, Matches, matches_by_camera
from calibgraph.preprocess import FILTERS, preprocess, preprocess_file
from calibgraph.problem import Clock, Fit, Poses, Problem
from calibgraph.rig import Rig
from calibgraph.stage1 import Stage1, estimate_stage1

Array = NDArray[np.float64]


def solve(
    rig: Rig,
    table: Correspondences | Path | str,
    config: Config | None = None,
    terms: Terms = "full",
) -> Calibration:
    """Calibrate all cameras of a rig jointly from correspondences.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        table: correspondences, their points in the LiDAR frame; or the file that holds them, which
            may be larger than memory: what the preprocessing keeps is held, nothing else.
        config: settings; the preset ``auto`` if None.
        terms: ``full``; ``reprojection`` (lambda = mu = 0); ``priors`` (no reprojection term);
            ``stage1`` (the aggregated per-frame PnP). The rig's ``relative_poses`` are
            measurements and take part in all but ``stage1``.

    Returns:
        The calibration, with a verdict that says whether it can be used, and the preprocessed
        correspondences.

    Raises:
        FileError: if the file cannot be read, or holds wrong values.
        CorrespondenceError: if a camera cannot be determined: fewer than 6 usable correspondences
            and no relative pose that ties it to a camera that has more.
        ValueError: if ``terms`` is unknown.
    """
    return judged(fit(rig, table, config, terms))


def fit(
    rig: Rig,
    table: Correspondences | Path | str,
    config: Config | None = None,
    terms: Terms = "full",
    *,
    stage1: Stage1 | None = None,
) -> Fit:
    """The two passes alone, see :func:`solve`; nothing is judged.

    The pairwise estimates may be given as ``stage1``, if they are known: to compare solves of the
    same correspondences without the PnP of every frame again.
    """
    if terms not in TERMS:
        raise ValueError(f"unknown terms {terms!r}; known are {', '.join(TERMS)}")
    config = config or Config()
    clock = Clock()
    with clock("preprocess"):
        if isinstance(table, Correspondences):
            kept = preprocess(rig, table, config)
        else:
            kept = preprocess_file(rig, table, config)
        _require_determined(rig, kept.counts)
        matches = matches_by_camera(rig, kept.table, config)
    with clock("stage1"):
        stage1 = stage1 or _stage1(rig, kept.table, config)
        start = _start(rig, matches, stage1, config=config, terms=terms)
    apart: dict[str, int] = {}
    if config.learnt_weights and config.stage1 == "pnp" and terms in ("full", "reprojection"):
        with clock("weights"):
            weighed = _weighed(kept.table, matches, stage1, start)
        matches = {name: w.matches for name, w in weighed.items()}
        start |= {name: w.T_camera_lidar for name, w in weighed.items()}
        apart = {name: w.frames_apart for name, w in weighed.items()}
    known = pose_graph(rig, stage1.T_camera_lidar, config, terms)
    problem = Problem(tuple(rig.cameras), matches, known, terms)
    with clock("pass1"):
        poses, scales = problem.settled(start, config)
    with clock("pass2"):
        inliers = problem.gated(poses, scales)
        optimum = inliers.minimize(poses, scales)
    return Fit(
        rig=rig,
        table=kept.table,
        config=config,
        problem=problem,
        inliers=inliers,
        scales=scales,
        optimum=optimum,
        stage1_T_camera_lidar=stage1.T_camera_lidar,
        counts=_counts(kept.counts, problem, inliers, stage1, apart),
        clock=clock,
    )


def _weighed(
    table: Correspondences, matches: Mapping[str, Matches], stage1: Stage1, start: Poses
) -> dict[str, Weighed]:
    """The matches of every camera, weighted by what their residuals say."""
    return {
        name: learn_weights(
            given,
            table.of_camera(name).confidence.astype(np.float64),
            start[name],
            stage1.solved.get(name, {}),
        )
        for name, given in matches.items()
    }


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
        correspondences=fit.table,
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
                f"(left after each filter: {left}): {_why_few(count)}{_of_others(tied)}",
                camera=name,
            )


def _of_others(tied: set[str]) -> str:
    """What to do for the cameras that have enough."""
    if not tied:
        return ""
    return f"; to calibrate {', '.join(sorted(tied))} without it, take it out of the rig file"


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
        return Stage1({name: rig.cameras[name].T_camera_lidar for name in named}, {}, {}, {})
    return estimate_stage1(rig, table, config)


def _start(
    rig: Rig,
    matches: Mapping[str, Matches],
    stage1: Stage1,
    *,
    config: Config,
    terms: Terms,
) -> Poses:
    """Where the first pass starts.

    Per camera it is the best of Stage 1, the poses of single frames and the rig's guess, by the
    errors of the matches of all frames with a Cauchy loss of half the PnP's threshold; with the
    terms ``stage1``, Stage 1 itself. Cameras without matches start where a relative pose puts them.
    """
    T_hat = stage1.T_camera_lidar
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
            candidates += [rig.cameras[name].T_camera_lidar, *stage1.solved.get(name, {}).values()]
        best = matches[name].best_explained_by(candidates, config.pnp_threshold_px / 2)
        start[name] = candidates[best]
    for _ in rig.cameras:
        for pair in rig.relative_poses:
            if pair.b in start:
                start.setdefault(pair.a, pair.T_a_b @ start[pair.b])
            if pair.a in start:
                start.setdefault(pair.b, np.linalg.inv(pair.T_a_b) @ start[pair.a])
    return {name: start[name] for name in rig.cameras}


def _counts(
    filters: Mapping[str, Mapping[str, int]],
    problem: Problem,
    inliers: Problem,
    stage1: Stage1,
    apart: Mapping[str, int],
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
            "frames": len(np.unique(given)) + apart.get(name, 0),
            "frames_apart": apart.get(name, 0),
            "frames_used": len(np.unique(used)),
            "frames_without_pnp": stage1.failed_frames.get(name, 0),
        }
    return counts
