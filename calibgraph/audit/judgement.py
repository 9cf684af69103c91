"""From a measured rig and its covariance to OK, WRONG or CANNOT TELL, per camera.

An axis with deviation d and standard deviation sigma is significant if |d| > q sigma; of 1000 rigs
without any deviation one has such an axis. Quantiles are of Student's t: sigma is itself estimated,
from the scatter of few frames; its stated part, of the error that all frames share, is known.

* WRONG: the length of the significant axes of a turn or a shift exceeds the tolerance.
* OK: each exceeds it with a probability of at most 5 %, given d and the covariance, and a change as
  large as the tolerance would be detected on every axis.
* CANNOT TELL: neither.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtri, fdtri, ndtri, stdtrit

from calibgraph.arrays import Array, Mask
from calibgraph.audit.result import CameraAudit, LidarAudit
from calibgraph.model.error_sources import MATCHES, MOST_TIMES, ErrorSources
from calibgraph.model.findings import UNKNOWN, MatcherFindings, error_components
from calibgraph.model.geometry import to_T_lidar_camera, twist_between
from calibgraph.solver.covariance import ENOUGH_FRAMES, PSEUDO_FRAMES
from calibgraph.tracking.cause import Steps, find_cause, squared_sigmas
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.probability import probability_outside
from factors import pose_sigmas

FALSE_ALARM_RATE = 1e-3
"""Probability of a significant axis on a rig, of all its cameras, that has not changed."""

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
    quantiles = _quantiles(evidence, name, sources)
    least = np.zeros(6)
    if sources is not None:
        now = np.array([sources.rotation_deg, sources.translation_cm])
        least = np.repeat(sources.forecast[MOST_TIMES] / now, 3)
    status, reason = judge_deviation(deviation, covariance, quantiles, tolerance, least=least)
    if status == "WRONG" and name in evidence.posteriors:
        posterior = evidence.posteriors[name]
        widest = posterior.widest(covariance)
        allowed = posterior.log_ratio < quantiles[0].max() ** 2
        if allowed or judge_deviation(deviation, widest, quantiles, tolerance)[0] != "WRONG":
            status, reason = "CANNOT TELL", f"{_IMAGES_ALLOW}; {reason}"
    if doubt:
        status, reason = "CANNOT TELL", doubt
    elif status == "WRONG" and len(evidence.cameras) == 1:
        reason += SINGLE_CAMERA
    smallest = detectable(sigma, quantiles[1])
    return CameraAudit(status, reason, deviation, sigma, smallest, z_score)


def has_too_few_frames(evidence: Evidence, name: str) -> bool:
    """True if the covariance is not estimated from this camera's frames."""
    block = evidence.solution.inliers.blocks.get(name)
    few = block is not None and block.frames < ENOUGH_FRAMES
    return few and evidence.covariance_of(name) is not None


def _quantiles(evidence: Evidence, name: str, sources: ErrorSources | None) -> Array:
    tail = tail_of_axis(len(evidence.cameras))
    known, block = student_quantiles(np.inf, tail), evidence.solution.inliers.blocks.get(name)
    if block is None or sources is None:
        return known
    estimated = student_quantiles(block.frames - 1 + PSEUDO_FRAMES, tail)
    shares = [axis.get(MATCHES, 0.0) for axis in (sources.rotation, sources.translation)]
    return quantiles_in_part(np.repeat(shares, 3), estimated, known)


def deviation_of(evidence: Evidence, name: str) -> Array:
    """(6,) log of the camera's pose now in its frame as deployed: T_deployed_now = exp(xi)."""
    solved, deployed = evidence.solution.T_camera_lidar, evidence.guess.T_camera_lidar
    return twist_between(deployed[name], solved[name])


def judge_deviation(
    deviation: Array,
    covariance: Array,
    quantiles: Array,
    tolerance: Array,
    *,
    least: Array | float = 0.0,
    axes: tuple[str, ...] = CAMERA_AXES,
    together: float = np.inf,
) -> tuple[str, str]:
    """The status of a trusted measurement, and its reason.

    Args:
        deviation: (6,) of all axes.
        covariance: (6, 6) of it.
        quantiles: (2, 6) of its standard deviations, see :func:`student_quantiles`.
        tolerance: (2,) of the turn [rad] and of the shift [m].
        least: (6,) share of sigma that remains however many frames are recorded.
        axes: (6) their names.
        together: squared sigmas of a turn or a shift from which on all its axes are significant.
    """
    sigma, (largest, confident) = np.sqrt(np.diag(covariance)), quantiles
    significant = np.abs(deviation) > largest * sigma
    for part in (slice(3), slice(3, 6)):
        significant[part] |= squared_sigmas(deviation[part], covariance[part, part]) > together
    wrong = axes_beyond(deviation, significant, tolerance)
    if wrong.any():
        return "WRONG", describe_motion(deviation, sigma, wrong, axes)
    needed, most = detectable(sigma, confident), np.repeat(tolerance, 3)
    blind = needed > most
    unsure = blind | _may_be_beyond(deviation, covariance, confident, tolerance)
    if unsure.any():
        found = describe_motion(deviation, sigma, unsure, axes)
        recording_helps = not (least * needed > most).any()
        advice = _advise(needed, blind, recording_helps=recording_helps)
        return "CANNOT TELL", f"may be beyond the tolerance: {found}; {advice}"
    if significant.any():
        moved = describe_motion(deviation, sigma, significant, axes)
        return "OK", f"within the tolerance, though significant: {moved}"
    return "OK", "no significant deviation, and within the tolerance"


def _may_be_beyond(deviation: Array, covariance: Array, confident: Array, tolerance: Array) -> Mask:
    """(6,) the largest axes of a turn or shift that is not certainly within the tolerance."""
    wider = confident / ndtri(CONFIDENCE)  # as few frames have it
    covariance = covariance * np.outer(wider, wider)
    reach = np.abs(deviation) + confident * np.sqrt(np.diag(covariance))
    unsure = np.zeros(6, np.bool_)
    for part, most in zip((slice(0, 3), slice(3, 6)), tolerance, strict=True):
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


def find_lidar_motion(
    deviation: Array,
    covariance: Array,
    T_camera_lidar: Sequence[Array],
    *,
    moved: Collection[int],
    quantile: float,
) -> LidarAudit | None:
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
        T_lidar_camera=tuple(to_T_lidar_camera(T) for T in T_camera_lidar),
    )
    lidar = find_cause(steps, moved).lidar
    if lidar is None:
        return None
    motion, sigma = -lidar[0], np.sqrt(np.diag(lidar[1]))
    clear = np.abs(motion) > quantile * sigma
    return LidarAudit(describe_motion(motion, sigma, clear, LIDAR_AXES), motion, sigma)


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


def axes_beyond(deviation: Array, significant: Mask, tolerance: Array) -> Mask:
    """(..., 6) True for the significant axes of a turn or a shift that are too large together.

    Args:
        deviation: (..., 6) rotation and translation.
        significant: (..., 6) the axes that count.
        tolerance: (2,) largest turn and shift.
    """
    parts = np.where(significant, deviation, 0.0).reshape(*deviation.shape[:-1], 2, 3)
    is_large = np.linalg.norm(parts, axis=-1) > tolerance
    return np.asarray(significant & np.repeat(is_large, 3, axis=-1))


def student_quantiles(freedom: ArrayLike, tail: float) -> Array:
    """(2, 6) numbers of sigmas: the largest deviation by chance; the upper bound by CONFIDENCE.

    Args:
        freedom: degrees of freedom of the sigmas, (6,) or of all; infinite where known.
        tail: probability of a larger deviation by chance, to either side.
    """
    freedom = np.broadcast_to(np.asarray(freedom, np.float64), 6)
    return np.array([-stdtrit(freedom, tail), stdtrit(freedom, CONFIDENCE)])


def limit_together(freedom: float, sensors: int) -> float:
    """Squared sigmas that a turn or a shift exceeds by chance: Hotelling's distribution."""
    quantile = fdtri(3, freedom - 2, 1 - FALSE_ALARM_RATE / (2 * sensors))
    return float(3 * freedom / (freedom - 2) * quantile)


def quantiles_in_part(share: Array, estimated: Array, known: Array) -> Array:
    """(2, 6) of a variance of which a (6,) share is estimated: squares add up (after Cochran).

    It errs on the side of fewer alarms: a quarter of the stated ones if the shares are alike.
    """
    return np.asarray(np.sqrt(share * estimated**2 + (1 - share) * known**2))


def tail_of_axis(cameras: int) -> float:
    """Probability of a significant deviation by chance, of one of six axes, to either side."""
    return FALSE_ALARM_RATE / (2 * 6 * cameras)


def detectable(sigma: Array, quantile: float | Array) -> Array:
    """(6,) the smallest change per axis that is beyond a quantile with probability POWER.

    Args:
        sigma: (6,) standard deviations.
        quantile: how many of them count, per axis or of all.
    """
    return np.asarray((quantile + float(ndtri(POWER))) * sigma)
