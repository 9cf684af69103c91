"""From a measured rig and its covariance to OK, WRONG or CANNOT TELL, per camera.

A turn or shift is significant as a whole by its squared sigmas (Hotelling), or along an axis by its
sigmas (Student); both since sigma is itself estimated, from the scatter of few frames; its stated
part, of the error that all frames share, is known. Of 1000 rigs that have not moved one has any.

* WRONG: the length of the significant axes of a turn or a shift exceeds the tolerance.
* OK: each exceeds it with a probability of at most 5 %, given d and the covariance, and a change as
  large as the tolerance would be detected on every axis.
* CANNOT TELL: neither.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, fdtri, ndtri, stdtrit

from calibgraph.arrays import Array, Mask
from calibgraph.audit.result import CameraAudit
from calibgraph.model.error_sources import MATCHES, MOST_TIMES, ErrorSources
from calibgraph.model.findings import UNKNOWN, MatcherFindings, error_components
from calibgraph.model.geometry import twist_between
from calibgraph.solver.covariance import ENOUGH_FRAMES, PSEUDO_FRAMES
from calibgraph.tracking.cause import Steps, find_cause
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.probability import probability_outside
from factors import pose_sigmas

FALSE_ALARM_RATE = 1e-3
"""Probability of a significant deviation on a rig, of all its sensors, that has not changed."""

POWER = 0.9
"""Probability with which the smallest detectable change is told from none."""

CONFIDENCE = 0.95
"""Probability that an axis that counts as within the tolerance is."""

DISPLAY = np.array([180 / np.pi] * 3 + [100.0] * 3)
"""From a twist [rad, m] to [deg, cm]."""

CAMERA_AXES = ("x (pitch)", "y (yaw)", "z (roll)", "x (right)", "y (down)", "z (ahead)")
LIDAR_AXES = ("x", "y", "z", "x", "y", "z")
_UNSEEN = "a change as large as the tolerance could go unseen"
_NO_ERROR_BAR = "the matches do not determine it: record structure near and far, all over the image"

_IMAGES_ALLOW = (
    "the images alone allow poses as far away, though the matches say otherwise: record frames at "
    "more places, of walls, poles or vehicles"
)

SEARCHES_FARTHER = (
    "if the extrinsic may be off by more than 3 deg or 40 cm, `calibgraph calibrate` searches "
    "farther"
)
SINGLE_LIDAR = "; of two LiDARs alone it is not known which has moved"
SINGLE_CAMERA = "; a single camera cannot be told from the LiDAR: either has moved"
_TOO_FEW_FRAMES = (
    f"too few frames for an error bar of their own (those of one place count as one): record at "
    f"least {ENOUGH_FRAMES}, better 30, of different places"
)


def judge_camera(evidence: Evidence, name: str, doubt: str, tolerance: Array) -> CameraAudit:
    """The audit of one camera."""
    z_score, covariance = evidence.findings.z_score.get(name), evidence.covariance_of(name)
    if name in evidence.solution.held:
        return CameraAudit("CANNOT TELL", f"{doubt}; {SEARCHES_FARTHER}", z_score=z_score)
    deviation = deviation_of(evidence, name)
    if covariance is None:
        return CameraAudit("CANNOT TELL", doubt or _NO_ERROR_BAR, deviation, z_score=z_score)
    if has_too_few_frames(evidence, name):
        return CameraAudit("CANNOT TELL", _TOO_FEW_FRAMES, deviation, z_score=z_score)
    if not evidence.findings.states_common_error:  # the prior, for a matcher that states none
        rad, metres = MatcherFindings(**error_components().matchers[UNKNOWN]).systematic_sigmas
        covariance = covariance + np.diag(pose_sigmas(rotation_rad=rad, translation_m=metres) ** 2)
    sigma = np.sqrt(np.diag(covariance))
    sources = evidence.error_sources.get(name)
    limits = _limits(evidence, name, sources, tolerance)
    least = np.zeros(6)
    if sources is not None:
        now = np.array([sources.rotation_deg, sources.translation_cm])
        least = np.repeat(sources.forecast[MOST_TIMES] / now, 3)
    status, reason = judge_deviation(deviation, covariance, limits, least=least)
    if status == "WRONG" and name in evidence.posteriors:
        posterior = evidence.posteriors[name]
        widest = posterior.widest(covariance)
        allowed = posterior.log_ratio < limits.axis.max() ** 2
        if allowed or judge_deviation(deviation, widest, limits)[0] != "WRONG":
            status, reason = "CANNOT TELL", f"{_IMAGES_ALLOW}; {reason}"
    if doubt:
        status, reason = "CANNOT TELL", doubt
    elif status == "WRONG" and len(evidence.cameras) == 1:
        reason += SINGLE_CAMERA
    smallest = detectable(sigma, limits.confident)
    return CameraAudit(status, reason, deviation, sigma, smallest, z_score)


def has_too_few_frames(evidence: Evidence, name: str) -> bool:
    """True if the covariance is not estimated from this camera's frames."""
    block = evidence.solution.inliers.blocks.get(name)
    few = block is not None and block.frames < ENOUGH_FRAMES
    return few and evidence.covariance_of(name) is not None


def _limits(
    evidence: Evidence, name: str, sources: ErrorSources | None, tolerance: Array
) -> Limits:
    rate = FALSE_ALARM_RATE / len(evidence.cameras)
    block = evidence.solution.inliers.blocks.get(name)
    if block is None or sources is None:
        return Limits.of(np.inf, rate, tolerance)
    shares = [axis.get(MATCHES, 0.0) for axis in (sources.rotation, sources.translation)]
    freedom = block.frames - 1 + PSEUDO_FRAMES
    return Limits.of(freedom, rate, tolerance, estimated=np.repeat(shares, 3))


def deviation_of(evidence: Evidence, name: str) -> Array:
    """(6,) log of the camera's pose now in its frame as deployed: T_deployed_now = exp(xi)."""
    solved, deployed = evidence.solution.T_camera_lidar, evidence.guess.T_camera_lidar
    return twist_between(deployed[name], solved[name])


def judge_deviation(
    deviation: Array,
    covariance: Array,
    limits: Limits,
    *,
    least: Array | float = 0.0,
    axes: tuple[str, ...] = CAMERA_AXES,
) -> tuple[str, str]:
    """The status of a trusted measurement, and its reason.

    Args:
        deviation: (6,) of all axes.
        covariance: (6, 6) of it.
        limits: of this measurement.
        least: (6,) share of sigma that remains however many frames are recorded.
        axes: (6) their names.
    """
    sigma, significant = np.sqrt(np.diag(covariance)), limits.significant(deviation, covariance)
    wrong = limits.exceeded(deviation, covariance)
    if wrong.any():
        return "WRONG", describe_motion(deviation, sigma, wrong, axes)
    needed, most = detectable(sigma, limits.confident), np.repeat(limits.tolerance, 3)
    blind = needed > most
    unsure = blind | _may_be_beyond(deviation, covariance, limits)
    if unsure.any():
        found = describe_motion(deviation, sigma, unsure, axes)
        recording_helps = not (least * needed > most).any()
        advice = _advise(needed, blind, recording_helps=recording_helps)
        return "CANNOT TELL", f"may be beyond the tolerance: {found}; {advice}"
    if significant.any():
        moved = describe_motion(deviation, sigma, significant, axes)
        return "OK", f"within the tolerance, though significant: {moved}"
    return "OK", "no significant deviation, and within the tolerance"


def _may_be_beyond(deviation: Array, covariance: Array, limits: Limits) -> Mask:
    """(6,) the largest axes of a turn or shift that is not certainly within the tolerance."""
    wider = limits.confident / ndtri(CONFIDENCE)  # as few frames have it
    covariance = covariance * np.outer(wider, wider)
    reach = np.abs(deviation) + limits.confident * np.sqrt(np.diag(covariance))
    unsure = np.zeros(6, np.bool_)
    for part, most in zip((slice(0, 3), slice(3, 6)), limits.tolerance, strict=True):
        beyond = probability_outside(deviation[part], covariance[part, part], most)
        if beyond > 1 - CONFIDENCE:
            unsure[part] = reach[part] > 0.5 * reach[part].max()
    return unsure


def _advise(needed: Array, blind: Mask, *, recording_helps: bool) -> str:
    """Advice about axes that may be beyond the tolerance."""
    if not blind.any():
        return "too near to the tolerance to decide: check another recording, of other places"
    enough = f"{np.degrees(needed[:3].max()):.2g} deg and {100 * needed[3:].max():.2g} cm"
    if not recording_helps:
        return f"{_UNSEEN}, however many frames are recorded: tolerate {enough}"
    near, all_over = "are within 10 m", "are all over the image"
    where = f"where walls, poles or vehicles {near if blind[3:].any() else all_over}"
    return f"{_UNSEEN}: tolerate {enough}, or record more frames, {where}"


class Measured(NamedTuple):
    """Sensors that were measured again.

    Attributes:
        audits: per sensor.
        deviations: (6,) of each, as of an audit.
        covariance: (6 k, 6 k) of all; None if one of them cannot be trusted.
        by_errors: (6 k, e) of the deviations by a standard deviation of errors of LiDARs' poses.
        poses: (4, 4) T_camera_lidar of each as deployed; another LiDAR counts as a camera.
    """

    audits: Mapping[str, CameraAudit]
    deviations: Sequence[Array] = ()
    covariance: Array | None = None
    by_errors: Array = np.empty((0, 0))
    poses: Sequence[Array] = ()


def find_lidar_motion(
    deviation: Array,
    covariance: Array,
    T_camera_lidar: Sequence[Array],
    *,
    moved: Collection[int],
    quantile: float,
) -> CameraAudit | None:
    """The motion of the LiDAR, if one explains the deviations of all cameras; else None.

    A LiDAR beside it is a camera here.

    Args:
        deviation: (6 N,) motions of the cameras in their own axes.
        covariance: (6 N, 6 N) of them.
        T_camera_lidar: (4, 4) each, before.
        moved: the cameras that deviate, by their places; with none the LiDAR has not moved either.
        quantile: number of sigmas from which on an axis of its motion is named.
    """
    if not moved:
        return None
    cameras = len(T_camera_lidar)
    steps = Steps(
        cameras=tuple(range(cameras)),
        step=deviation,
        covariance=covariance,
        limits=np.full(cameras, float(chdtri(6, FALSE_ALARM_RATE / cameras))),
        T_camera_lidar=np.array(T_camera_lidar),
    )
    lidar = find_cause(steps, moved).lidar
    if lidar is None:
        return None
    motion, sigma = -lidar[0], np.sqrt(np.diag(lidar[1]))
    clear = np.abs(motion) > quantile * sigma
    reason = describe_motion(motion, sigma, clear, LIDAR_AXES)
    return CameraAudit("WRONG", reason, motion, sigma)


def describe_motion(motion: Array, sigma: Array, which: Mask, axes: tuple[str, ...]) -> str:
    """A motion about and along some axes, in words.

    Args:
        motion: (6,) rotation [rad], translation [m].
        sigma: (6,) its standard deviations.
        which: (6,) the axes to name.
        axes: (6) their names.
    """
    values, errors = motion * DISPLAY, sigma * DISPLAY
    verbs, units = np.repeat([["turned about", "moved along"], ["deg", "cm"]], 3, axis=1)
    return ", ".join(
        f"{verbs[k]} {axes[k]} by {values[k]:+.2f} {units[k]} (sigma {errors[k]:.2f})"
        for k in np.flatnonzero(which)
    )


def tolerance_twist(tolerance_deg: float, tolerance_cm: float) -> Array:
    """(2,) the largest turn [rad] and the largest shift [m] that are OK, whatever their axes.

    Raises:
        ValueError: if one is not positive.
    """
    for name, value in (("tolerance_deg", tolerance_deg), ("tolerance_cm", tolerance_cm)):
        if not 0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, found {value}")
    return np.asarray(np.array([tolerance_deg, tolerance_cm]) / DISPLAY[::3])


@dataclass(frozen=True, eq=False)
class Limits:
    """What a measured deviation is compared with.

    Attributes:
        axis: (..., 6) sigmas along an axis that chance does not explain.
        whole: (..., 2) squared sigmas of a turn, and of a shift, that it does not explain.
        confident: (..., 6) sigmas of an upper bound by CONFIDENCE.
        tolerance: (2,) largest turn [rad] and shift [m].
    """

    axis: Array
    whole: Array
    confident: Array
    tolerance: Array

    @classmethod
    def of(
        cls, freedom: ArrayLike, rate: float, tolerance: Array, *, estimated: Array | float = 1.0
    ) -> Limits:
        """The limits of a sensor that without a motion exceeds one with some probability.

        Half of it is for the axes, to either side, and half for the turn and shift as a whole.

        Args:
            freedom: degrees of freedom of the sigmas, (..., 6) or of all; infinite where known.
            rate: the probability.
            tolerance: (2,) largest turn [rad] and shift [m].
            estimated: (..., 6) share of the variances that is estimated; the rest is known. Squares
                add up (after Cochran): a quarter of the alarms if the shares are alike.
        """
        freedom = np.broadcast_to(freedom, np.broadcast_shapes(np.shape(freedom), (6,)))
        known, tail = np.full(6, np.inf), rate / (2 * 2 * 6)
        axis, confident, whole = (
            estimated * of(freedom) + (1 - estimated) * of(known)
            for of in (
                lambda nu: stdtrit(nu, tail) ** 2,
                lambda nu: stdtrit(nu, CONFIDENCE) ** 2,
                lambda nu: _hotelling(nu, rate / (2 * 2)),
            )
        )
        largest = whole.reshape(*whole.shape[:-1], 2, 3).max(axis=-1)
        return cls(np.sqrt(axis), largest, np.sqrt(confident), tolerance)

    def significant(self, deviation: Array, covariance: Array) -> Mask:
        """(..., 6) the axes beyond their limit; all of a turn or shift that only as a whole is."""
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        found = np.abs(deviation) > self.axis * sigma
        for k, part in enumerate((slice(3), slice(3, 6))):
            xi = deviation[..., part, None]
            squared = (xi * np.linalg.solve(covariance[..., part, part], xi)).sum(axis=(-2, -1))
            only_whole = (squared > self.whole[..., k]) & ~found[..., part].any(axis=-1)
            found[..., part] |= only_whole[..., None]
        return np.asarray(found)

    def exceeded(self, deviation: Array, covariance: Array) -> Mask:
        """(..., 6) the significant axes of a turn or shift that together exceed the tolerance."""
        significant = self.significant(deviation, covariance)
        parts = np.where(significant, deviation, 0.0).reshape(*deviation.shape[:-1], 2, 3)
        is_large = np.linalg.norm(parts, axis=-1) > self.tolerance
        return np.asarray(significant & np.repeat(is_large, 3, axis=-1))


def _hotelling(freedom: Array, tail: float) -> Array:
    """Squared sigmas of three axes, estimated together, that chance exceeds so often."""
    free = np.where(np.isinf(freedom), 1e9, freedom) - 2
    return np.asarray(3 * (free + 2) / free * fdtri(3, free, 1 - tail))


def detectable(sigma: Array, quantile: float | Array) -> Array:
    """(6,) the smallest change per axis that is beyond a quantile with probability POWER.

    Args:
        sigma: (6,) standard deviations.
        quantile: how many of them count, per axis or of all.
    """
    return np.asarray((quantile + float(ndtri(POWER))) * sigma)
