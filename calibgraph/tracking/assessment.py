"""Assessment of the present estimate: covariance, verdicts, and the result as a calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Calibration, Residuals
from calibgraph.model.geometry import pose_rows, to_T_camera_lidar
from calibgraph.model.verdict import Check, Verdict
from calibgraph.solver.conflicts import Conflict, relative_pose_conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES, with_pseudo_frames
from calibgraph.solver.curvature import pose_hessian
from calibgraph.solver.factor_graph import relative_pose_graph
from calibgraph.tracking.halves import Halves
from calibgraph.tracking.noise import median
from calibgraph.tracking.posterior import Posterior, is_determined, posterior
from calibgraph.tracking.state import CameraState, State, block_diagonal
from calibgraph.tracking.window import kept_pairs, pose_priors
from calibgraph.trust.estimate import Estimate
from calibgraph.trust.solution_checks import check_estimate
from calibgraph.trust.thresholds import threshold
from factors import pose_sigmas

Array = NDArray[np.float64]

_PRIOR_FRAMES = 10.0  # weight of the scatter of all frames so far, while a camera has few


@dataclass(frozen=True, eq=False)
class Assessment:
    """Covariance and verdicts of all estimates.

    Attributes:
        joint_covariance: (6 n, 6 n) of xi in T_camera_lidar = exp(xi) estimate; NaN for cameras
            with too few frames.
        verdicts: per camera.
    """

    joint_covariance: Array
    verdicts: dict[str, Verdict]


@dataclass(frozen=True, eq=False)
class PriorHessians:
    """Hessians of the terms without correspondences, (6 n, 6 n).

    Attributes:
        whole: of priors and measured relative poses.
        measured: of the measured relative poses, which is also the covariance of their gradients.
    """

    whole: Array
    measured: Array


def joint_covariance(state: State, sums: Posterior, prior: PriorHessians) -> Array:
    """(6 n, 6 n) cluster-robust covariance; NaN for cameras with too few frames.

    While a camera has few frames, its scatter is shrunk towards that of all its frames so far.
    """
    share = np.array([
        0.0 if one.summary.walk else _PRIOR_FRAMES / (frames + _PRIOR_FRAMES)
        for one, frames in zip(state.cameras, sums.frames, strict=True)
    ])  # fmt: skip
    usual = np.sqrt(share * sums.frames / np.maximum(state.total_frames, 1.0))
    scatter = _scaled(sums.scatter, np.sqrt(1 - share)) + _scaled(state.total, usual)
    hessian = block_diagonal(sums.hessian) + prior.whole
    scatter = with_pseudo_frames(state.widen(scatter), hessian, np.repeat(sums.frames, 6))
    covariance = replace(sums, scatter=scatter + prior.measured).covariance(prior.whole)
    rotation, translation = state.systematic_sigmas
    shared = pose_sigmas(rotation_rad=rotation, translation_m=translation)
    covariance += np.diag(np.tile(shared**2, len(state.cameras)))
    few = np.repeat(sums.frames < ENOUGH_FRAMES, 6)
    covariance[few], covariance[:, few] = np.nan, np.nan
    return covariance


def _scaled(scatter: Array, factors: Array) -> Array:
    """(6 n, 6 n) with each camera's gradients multiplied by a factor."""
    each = np.repeat(factors, 6)
    return scatter * np.outer(each, each)


def assess(state: State, sums: Posterior, halves: Halves, prior: PriorHessians) -> Assessment:
    """Assess the present estimates.

    Args:
        state: the tracker's.
        sums: over its summaries and live frames.
        halves: the same sums, of every other epoch.
        prior: of priors and relative poses.
    """
    covariance = joint_covariance(state, sums, prior)
    conflicts = _conflicts(state, sums, covariance)
    verdicts = {}
    for camera, name in enumerate(state.names):
        own = tuple(c for c in conflicts if name in (c.pair.a, c.pair.b))
        estimates = halves.estimates(state, camera)
        verdicts[name] = _verdict(state, sums, camera, covariance, conflicts=own, halves=estimates)
    return Assessment(covariance, verdicts)


def _verdict(
    state: State,
    sums: Posterior,
    camera: int,
    covariance: Array,
    *,
    conflicts: tuple[Conflict, ...],
    halves: tuple[Array, Array] | None,
) -> Verdict:
    name, one = state.names[camera], state.cameras[camera]
    if not one.started:
        return _start_check(state, one)
    rows = pose_rows(camera)
    own = covariance[rows, rows]
    estimate = Estimate(
        camera=state.rig.cameras[name],
        residuals=recent_residuals(one),
        used=int(one.counts.get("used", 0)),
        frames=int(sums.frames[camera]),
        covariance=None if np.isnan(own).any() else own,
        data_sigmas=_data_sigmas(sums.hessian[camera]),
        halves=halves,
        conflicts=conflicts,
        pull=None,
        converged=True,
        terms="full",
    )
    return Verdict((*check_estimate(estimate), *_recent_checks(state, one)))


def _start_check(state: State, one: CameraState) -> Verdict:
    needed = state.config.tracking.start_frames
    waiting = (f"{len(one.waiting)} of {needed} frames with matches",)
    return Verdict(
        tuple(
            Check("start", "FAIL", f"no estimate yet: {reason}")
            for reason in one.refused or waiting
        )
    )


def _recent_checks(state: State, one: CameraState) -> list[Check]:
    """Checks of a camera's last frames."""
    checks = []
    if one.absent >= state.config.tracking.blind_frames:
        text = f"no usable matches in the last {one.absent} frames"
        checks.append(Check("blind frames", "WARN", text, one.absent))
    if one.summary.walk:
        text = "drifts: the estimate follows, over fewer frames"
        checks.append(Check("drift", "WARN", text))
    agreements = [good for _, good in one.agreements]
    if agreements:
        share = 1 - float(np.mean(agreements))
        name = f"share of the last {len(agreements)} frames that disagree with the estimate"
        checks.append(threshold("disagreeing_frames").check(share, name=name))
    return checks


def recent_residuals(one: CameraState) -> Residuals:
    """Residuals of the recent frames."""
    return Residuals(
        median_px=median(one.recent[:, 1]),
        inlier_share=one.inlier_share,
        sigma_px=one.scale.sigma_px,
        loss_scale_px=one.scale.loss_scale,
        gate_px=one.scale.gate_px,
    )


def _data_sigmas(hessian: Array) -> Array:
    """(6,) standard deviations if every match were independent: a lower bound."""
    if not is_determined(hessian):
        return np.full(6, np.inf)
    return np.sqrt(np.diag(np.linalg.inv(hessian)))


def _conflicts(state: State, sums: Posterior, covariance: Array) -> list[Conflict]:
    """Conflicts between the rig's relative poses and the correspondences alone."""
    places = {name: camera for camera, name in enumerate(state.names)}
    conflicts = []
    for place, pair in enumerate(state.rig.relative_poses):
        cameras = [places[pair.a], places[pair.b]]
        if place in state.dropped_pairs or not all(state.cameras[c].started for c in cameras):
            continue
        one, two = (sums.step(c) for c in cameras)
        rows = np.concatenate([6 * c + np.arange(6) for c in cameras])
        alone = replace(
            sums,
            hessian=sums.hessian[cameras],
            scatter=sums.scatter[np.ix_(rows, rows)],
            frames=sums.frames[cameras],
        )
        if one is None or two is None or np.isnan(covariance[np.ix_(rows, rows)]).any():
            continue
        T = {
            name: to_T_camera_lidar(state.references[c].retract(step))
            for name, c, step in zip((pair.a, pair.b), cameras, (one, two), strict=True)
        }
        joint = alone.covariance(np.zeros((12, 12)))
        conflicts.append(relative_pose_conflict(pair, (pair.a, pair.b), T, joint))
    return conflicts


def prior_hessians(state: State) -> PriorHessians:
    """Hessians without correspondences."""
    T = {
        name: to_T_camera_lidar(p)
        for name, p in zip(state.names, state.T_lidar_camera, strict=True)
    }
    measured = relative_pose_graph(state.names, kept_pairs(state))
    return PriorHessians(
        pose_hessian(pose_priors(state), state.names, T), pose_hessian(measured, state.names, T)
    )


def covariance_by_camera(assessment: Assessment, names: tuple[str, ...]) -> dict[str, Array | None]:
    """Per camera (6, 6); None with too few frames."""
    covariance: dict[str, Array | None] = {}
    for camera, name in enumerate(names):
        rows = pose_rows(camera)
        own = assessment.joint_covariance[rows, rows]
        covariance[name] = None if np.isnan(own).any() else own
    return covariance


def _counts(one: CameraState) -> dict[str, int]:
    """Correspondences and frames, by what became of them."""
    counts = {key: one.counts.get(key, 0) for key in ("given", "used", "left_out", "failed")}
    used, waiting = one.counts.get("absorbed", 0), len(one.waiting)
    frames = used + counts["left_out"] + waiting
    return {**counts, "frames": frames, "frames_used": used, "frames_waiting": waiting}


def to_calibration(state: State) -> Calibration:
    """The present estimate as a result of the same type as a batch's."""
    sums = posterior(state)
    halves = Halves.of_closed_epochs(state).add(state.epochs[-1].frames)
    assessment = assess(state, sums, halves, prior_hessians(state))
    estimates = zip(state.names, state.T_lidar_camera, strict=True)
    joint = assessment.joint_covariance
    return Calibration(
        rig=state.rig.moved_to({name: to_T_camera_lidar(T) for name, T in estimates}),
        initial_rig=state.rig,
        covariance=covariance_by_camera(assessment, state.names),
        joint_covariance=None if np.isnan(joint).any() else joint,
        camera_verdicts=assessment.verdicts,
        residuals={
            name: recent_residuals(one)
            for name, one in zip(state.names, state.cameras, strict=True)
            if one.started
        },
        counts={n: _counts(one) for n, one in zip(state.names, state.cameras, strict=True)},
        timings_s={},
        terms="full",
        config=state.config,
    )
