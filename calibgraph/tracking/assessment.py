"""Assessment of the present estimate: its verdicts, and the result as a calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.calibration import Calibration, Residuals
from calibgraph.model.geometry import pair_covariances, pose_rows, to_T_camera_lidar
from calibgraph.model.rig import RelativePose, Rig
from calibgraph.model.verdict import START, Check, Status, Verdict
from calibgraph.solver.conflicts import Conflict
from calibgraph.solver.covariance import ENOUGH_FRAMES
from calibgraph.tracking.camera_state import CameraState
from calibgraph.tracking.closed_places import ClosedPlaces
from calibgraph.tracking.contradictions import contradicting, pairs_without
from calibgraph.tracking.noise import median
from calibgraph.tracking.optimum import Optimum
from calibgraph.tracking.shown_frames import groups_by_frames
from calibgraph.tracking.sources import error_sources
from calibgraph.tracking.state import State
from calibgraph.tracking.sums import Sums, step_between
from calibgraph.tracking.window import Window
from calibgraph.trust.evidence import Estimate
from calibgraph.trust.pose_posterior import (
    ImagePosteriors,
    PosePosterior,
    group_tied,
    measured_pairs,
)
from calibgraph.trust.solution_checks import check_estimate
from calibgraph.trust.thresholds import threshold
from factors.conditioning import sigmas_of_hessian

MeasureOnFrames = Callable[
    [Sequence[int], Mapping[str, Array], Sequence[Sequence[str]]], Mapping[str, PosePosterior]
]
"""As ``MeasurePosteriors``, on the frames of some numbers."""

NOT_COMPARED = "its images were not compared with the clouds: no frame that is at hand shows it"


@dataclass(frozen=True, eq=False)
class Assessment:
    """All estimates, their covariance and verdicts.

    Attributes:
        T_lidar_camera: per camera.
        joint_covariance: (6 n, 6 n) of xi in T_camera_lidar = exp(xi) estimate; NaN for cameras
            with too few frames.
        verdicts: per camera.
        window: the graph at its optimum, until the next frame.
        pairs: the relative poses that take part.
    """

    T_lidar_camera: tuple[gtsam.Pose3, ...]
    joint_covariance: Array
    verdicts: dict[str, Verdict]
    window: Window
    pairs: tuple[RelativePose, ...] = ()

    def newest(self, optimum: Optimum | None) -> Optimum | None:
        """The optimum of closed epochs, with the newer poses of this one."""
        newer = Optimum.of(self.window.model, self.window.values, self.window.places, ())
        return None if optimum is None else optimum.updated(newer)


def assess(state: State, closed: ClosedPlaces, window: Window | None) -> Assessment:
    """Assess the present estimates.

    A relative pose that contradicts the correspondences of both its cameras takes no part, as in a
    batch.

    Args:
        state: the tracker's.
        closed: its closed epochs.
        window: of the frame before, if of the same epoch.
    """
    sums = closed.all_sums(state)
    window, conflicts = closed.with_open_epoch(state, window)
    keys, estimates = window.model.reported_keys, state.T_lidar_camera
    if state.config.preset == "auto":
        estimates = window.T_lidar_camera(keys)
    covariance, few = window.covariance(keys), np.repeat(sums.frames < ENOUGH_FRAMES, 6)
    covariance[few], covariance[:, few] = np.nan, np.nan
    verdicts = {}
    for camera, name in enumerate(state.names):
        own = tuple(c for c in conflicts.values() if name in (c.pair.a, c.pair.b))
        verdicts[name] = _verdict(state, sums, camera, covariance, conflicts=own)
    pairs = pairs_without(state, contradicting(conflicts))
    return Assessment(estimates, covariance, verdicts, window, pairs)


def with_images(
    state: State, assessment: Assessment, measure: MeasureOnFrames | None
) -> tuple[Assessment, ImagePosteriors]:
    """The assessment with error bars and verdicts by the posteriors of cameras with error bars.

    Without ``measure`` it stays as it is.
    """
    own = covariance_by_camera(assessment, state.names)
    known = {name: covariance for name, covariance in own.items() if covariance is not None}
    groups = group_tied(tuple(known), measured_pairs(assessment.pairs))
    posteriors: dict[str, PosePosterior] = {}
    if measure is not None:
        for frames, of_frames in groups_by_frames(state, groups).items():
            posteriors |= measure(frames, known, of_frames)
    images = ImagePosteriors(state.names, assessment.joint_covariance, posteriors)
    row, flatness, verdicts = threshold("beyond_tolerance"), images.check_flatness(), {}
    for name, verdict in assessment.verdicts.items():
        more = []
        if name in flatness:
            beyond = images.probability_beyond(name, state.config.tolerance)
            more = [flatness[name], row.check(beyond)]
        elif measure is not None and name in known:
            more = [Check("image evidence", "WARN", NOT_COMPARED)]
        verdicts[name] = Verdict((*verdict.checks, *more))
    joint = images.widen(assessment.joint_covariance)
    return replace(assessment, joint_covariance=joint, verdicts=verdicts), images


def _verdict(
    state: State,
    sums: Sums,
    camera: int,
    covariance: Array,
    *,
    conflicts: tuple[Conflict, ...],
) -> Verdict:
    one = state.cameras[camera]
    if not one.started:
        return _start_check(state, one)
    rows = pose_rows(camera)
    own = covariance[rows, rows]
    estimate = Estimate(
        has_matches=True,
        used=int(one.counts.get("used", 0)),
        frames=int(sums.frames[camera]),
        covariance=None if np.isnan(own).any() else own,
        data_sigmas=sigmas_of_hessian(sums.hessian[camera]),
        conflicts=conflicts,
        scatter_only=not state.findings.states_common_error,
        tolerance=state.config.tolerance,
    )
    return Verdict((*check_estimate(estimate), *_recent_checks(state, one)))


def _stuck_check(one: CameraState, status: Status) -> Check:
    text = f"the last {one.counts['repeated'] + 1} frames with matches have the same points"
    return Check("stuck", status, f"{text}: its stream is stuck, or sends them again")


def _start_check(state: State, one: CameraState) -> Verdict:
    needed = state.config.tracking.start_frames
    if one.counts.get("repeated", 0) >= state.config.tracking.blind_frames:
        return Verdict((_stuck_check(one, "FAIL"),))
    waiting = (f"{len(one.waiting)} of {needed} frames with matches",)
    reasons = (f"no estimate yet: {reason}" for reason in one.refused or waiting)
    return Verdict(tuple(Check(START, "WARN", reason) for reason in reasons))


def _recent_checks(state: State, one: CameraState) -> list[Check]:
    """Checks of a camera's last frames."""
    checks = []
    limit = state.config.tracking.blind_frames
    repeated = one.counts.get("repeated", 0)
    if repeated >= limit > one.absent - repeated:
        checks.append(_stuck_check(one, "WARN"))
    elif one.absent >= limit:
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


def rig_at(state: State, T_lidar_camera: Sequence[gtsam.Pose3]) -> Rig:
    """The rig with these estimates."""
    estimates = zip(state.names, T_lidar_camera, strict=True)
    return state.rig.moved_to({name: to_T_camera_lidar(T) for name, T in estimates})


def second_moments(assessment: Assessment) -> Array:
    """(6 n, 6 n) of the mounts about the estimates."""
    window, keys = assessment.window, assessment.window.model.camera_keys
    steps = zip(window.T_lidar_camera(keys), assessment.T_lidar_camera, strict=True)
    away = np.concatenate([step_between(pose, estimate) for pose, estimate in steps])
    return np.asarray(window.covariance(keys) + np.outer(away, away))


def to_calibration(
    state: State,
    assessment: Assessment,
    measure: MeasureOnFrames | None = None,
    *,
    sources: bool = False,
) -> Calibration:
    """The present estimate as a result of the same type as a batch's."""
    assessment, images = with_images(state, assessment, measure)
    joint = assessment.joint_covariance
    known = None if np.isnan(joint).any() else joint
    mounts = None if known is None else images.widen(second_moments(assessment))
    rig = rig_at(state, assessment.T_lidar_camera)
    return Calibration(
        rig=rig,
        initial_rig=state.rig,
        covariance=covariance_by_camera(assessment, state.names),
        joint_covariance=known,
        pair_covariance=pair_covariances(mounts, rig.T_camera_lidar),
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
        error_sources=error_sources(state, known) if sources else {},
        moves=tuple(map(str, state.moves)),
    )
