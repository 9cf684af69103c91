"""``drift``: which of several results of one rig deviates, of which camera, in which axis?"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.audit.common_pose import Deviations, Limits, compare, poses_of
from calibgraph.audit.drift_result import (
    CameraDrift,
    Drift,
    DriftStatus,
    Results,
    Trend,
    open_results,
    pairs_of_one_recording,
)
from calibgraph.audit.judgement import (
    CAMERA_AXES,
    SINGLE_CAMERA,
    describe_motion,
    find_lidar_motion,
    judge_deviation,
)
from calibgraph.audit.result import LidarAudit
from calibgraph.audit.significance import Quantiles, Tolerance, detectable
from calibgraph.audit.trend import fit_slope
from calibgraph.model.calibration import Calibration
from calibgraph.model.geometry import pose_rows
from calibgraph.model.verdict import COMMON_ERROR
from calibgraph.solver.covariance import PSEUDO_FRAMES

FALSE_ALARM_RATE = 0.01
"""Probability of a significant axis in one call, over all cameras, results and trends."""

_LATEST_DAY = 1e9  # twice the present time in seconds

_FAILED = "its verdict is FAIL, so that nothing is known of its error: do what its report advises"
_NO_ERROR_BAR = "it has no error bar: its matches do not determine the camera"
_SCATTER_ONLY = (
    "its error bar is of the scatter alone: solve it again with --common-deg, --common-cm"
)
_ALONE = "no other result has an error bar of this camera that holds; give more results"


def drift(
    results: Results,
    *,
    days: Sequence[float] | None = None,
    tolerance_deg: float = 0.5,
    tolerance_cm: float = 10.0,
    own_lenses: bool = False,
) -> Drift:
    """Compare results of one rig with each other, without a reference: of days, or of vehicles.

    Each result is compared with the weighted mean of the others that agree. Errors that all
    results share, of the matcher or of the lens, cancel in a difference; results do not state how
    large this part is, so that the whole covariances count, and the test is conservative.

    Args:
        results: two or more, or their folders or files; of a mapping the keys are their names.
        days: when each was recorded, for the trend; the order given if None.
        tolerance_deg: largest turn of a camera that is OK.
        tolerance_cm: largest shift of a camera that is OK.
        own_lenses: whether the parameters of the lenses may differ, as between vehicles.

    Returns:
        Per camera and result OK, CHANGED or CANNOT TELL, the deviation per axis, its error bar and
        the smallest change that would be detected.

    Raises:
        CalibrationError: if a file cannot be read, or the results are not of one rig.
        ValueError: if a tolerance is not positive, or there is not a day for each result.
    """
    tolerance = Tolerance(tolerance_deg, tolerance_cm)
    opened = open_results(results, own_lenses=own_lenses)
    loaded, at = [*opened.values()], _times(days, len(opened))
    cameras = [*loaded[0].rig.cameras]
    tests = 6 * len(cameras) * (len(loaded) + 1)
    limits = Limits(FALSE_ALARM_RATE / (2 * tests), tolerance.twist)
    found = {name: _compare_camera(loaded, name, limits) for name in cameras}
    compared = {name: each for name, each in found.items() if each is not None}
    judged = {
        name: _judge_camera(
            [*opened], loaded, name, compared.get(name), limits=limits, tolerance=tolerance
        )
        for name in cameras
    }
    unit = "result" if days is None else "day"
    trends = {name: _trend(each, at, unit, limits) for name, each in compared.items()}
    return Drift(
        results=(*opened,),
        at=at,
        cameras=judged,
        trends={name: trend for name, trend in trends.items() if trend is not None},
        lidar=tuple(_lidar(place, loaded, compared, judged, limits=limits)
                    for place in range(len(loaded))),
        tolerance_deg=tolerance_deg,
        tolerance_cm=tolerance_cm,
        false_alarm_rate=FALSE_ALARM_RATE,
        same_recording=pairs_of_one_recording(opened),
    )  # fmt: skip


def _times(days: Sequence[float] | None, count: int) -> Array:
    """(n,) days, or places."""
    at = np.arange(count, dtype=np.float64) if days is None else np.array(days, np.float64)
    if at.shape != (count,) or not (np.abs(at) <= _LATEST_DAY).all():
        raise ValueError(
            f"days: expected {count} numbers up to {_LATEST_DAY:g}, one per result, found {days}"
        )
    return at


def _why_unusable(result: Calibration, name: str) -> str:
    """Why the pose of a camera takes no part; empty if it does."""
    if not result.error_bar_holds(name):
        return _FAILED
    covariance = result.covariance[name]
    if covariance is None or np.linalg.eigvalsh(covariance)[0] <= 0:
        return _NO_ERROR_BAR
    if any(check.kind == COMMON_ERROR for check in result.camera_verdicts[name].checks):
        return _SCATTER_ONLY
    return ""


def _compare_camera(results: list[Calibration], name: str, limits: Limits) -> Deviations | None:
    """The deviations of one camera; None with fewer than two usable results."""
    usable = [place for place, each in enumerate(results) if not _why_unusable(each, name)]
    if len(usable) < 2:  # noqa: PLR2004 - a comparison
        return None
    T_camera_lidar = np.array([results[place].T_camera_lidar[name] for place in usable])
    covariance = np.array([results[place].covariance[name] for place in usable])
    frames = np.array([results[place].counts[name].get("frames_used", 1) for place in usable])
    freedom = np.maximum(frames, 1.0) - 1.0 + PSEUDO_FRAMES
    return compare(poses_of(usable, T_camera_lidar, covariance, freedom), limits)


def _judge_camera(
    names: list[str],
    results: list[Calibration],
    camera: str,
    found: Deviations | None,
    *,
    limits: Limits,
    tolerance: Tolerance,
) -> tuple[CameraDrift, ...]:
    """The status of one camera in every result."""
    judged = [CameraDrift("CANNOT TELL", _why_unusable(each, camera) or _ALONE) for each in results]
    if found is None:
        return tuple(judged)
    for row, place in enumerate(found.poses.results):
        deviation, sigma = found.leave_one_out.deviation[row], found.leave_one_out.sigma[row]
        covariance = found.leave_one_out.covariance[row]
        quantiles = Quantiles.from_freedom(found.leave_one_out.freedom[row], limits.tail)
        audit, reason = judge_deviation(deviation, covariance, quantiles, tolerance)
        status: DriftStatus = "CHANGED" if audit == "WRONG" else audit
        axes: tuple[int, ...] = ()
        if status == "CHANGED":
            axes = tuple(np.flatnonzero(found.leave_one_out.axes_beyond(limits)[row]).tolist())
            reason += _whose_change(found, row, names)
            reason += SINGLE_CAMERA if len(results[0].rig.cameras) == 1 else ""
        smallest = detectable(sigma, quantiles.significant)
        judged[place] = CameraDrift(status, reason, deviation, sigma, smallest, axes)
    return tuple(judged)


def _whose_change(found: Deviations, row: int, names: list[str]) -> str:
    """The other results that may have changed instead, as the end of a sentence; may be empty."""
    count, agreeing = len(found.poses), np.count_nonzero(found.agreeing)
    others = [names[found.poses.results[other]] for other in np.flatnonzero(found.ambiguous[row])]
    if not others:
        return ""
    if count == 2:  # noqa: PLR2004 - no majority
        return f" from {others[0]}; of two results it is not known which changed: give a third"
    if 2 * agreeing <= count:
        return "; no more than half of the results agree, so that it is not known which changed"
    return f"; it may be {' or '.join(others)} that changed, not this result: give more results"


def _trend(found: Deviations, at: Array, unit: str, limits: Limits) -> Trend | None:
    """The steady motion of one camera; None with fewer than three results, or of one time.

    It counts if it explains the results better than changes of single ones, by what is left of
    the scatter and twice the numbers that each needs (Akaike's criterion).
    """
    poses, count = found.poses, len(found.poses)
    x = at[poses.results]
    one_batch = np.zeros(count, np.intp)
    slope = fit_slope(x, one_batch, poses.information, poses.twist)
    if count < 3 or slope is None:  # noqa: PLR2004 - a line passes through two
        return None
    span = float(np.ptp(x))
    whole, sigma = slope.change * span, slope.sigma * span
    freedom = np.array(poses.freedom.sum())
    everyone, single = np.ones(count, np.bool_), np.count_nonzero(~found.agreeing)
    by_slope = poses.scatter(everyone) - slope.squared_sigmas + 2 * 6
    by_changes = poses.scatter(found.agreeing) + 2 * 6 * single
    beyond = bool(limits.exceeded(whole, sigma, freedom).any())
    changed = beyond and bool(by_slope < by_changes)
    clear = np.abs(whole) > limits.sigmas(freedom) * sigma
    reason = "no significant trend"
    if clear.any():
        motion = describe_motion(whole, sigma, clear, CAMERA_AXES)
        reason = f"{motion} from the first to the last result"
        if not beyond:
            reason += ", within the tolerance"
        elif not changed:
            reason += "; changes of single results explain it better"
    return Trend(changed, reason, slope.change, slope.sigma, unit, span)


def _lidar(
    place: int,
    results: list[Calibration],
    compared: dict[str, Deviations],
    judged: dict[str, tuple[CameraDrift, ...]],
    *,
    limits: Limits,
) -> LidarAudit | None:
    """The motion of the LiDAR that explains how all cameras of one result deviate, if one does."""
    seen = {name: each for name, each in compared.items() if place in each.poses.results}
    moved = [k for k, name in enumerate(seen) if judged[name][place].status == "CHANGED"]
    if len(seen) < 2 or not moved:  # noqa: PLR2004 - one camera cannot be told from the LiDAR
        return None
    covariance = _joint_covariance(place, results, seen)
    if covariance is None:
        return None
    rows = [int(np.flatnonzero(each.poses.results == place)[0]) for each in seen.values()]
    parts = [(each.leave_one_out, row) for each, row in zip(seen.values(), rows, strict=True)]
    deviation = np.concatenate([each.deviation[row] for each, row in parts])
    freedom = np.min([each.freedom[row] for each, row in parts])
    bases = [each.poses.base for each in seen.values()]
    return find_lidar_motion(
        deviation, covariance, bases, moved=moved, quantile=float(limits.sigmas(freedom))
    )


def _joint_covariance(
    place: int, results: list[Calibration], seen: dict[str, Deviations]
) -> Array | None:
    """(6 N, 6 N) of one result's deviations of these cameras; None if it is not known."""
    gains = {name: each.coefficients(int(np.flatnonzero(each.poses.results == place)[0]))
             for name, each in seen.items()}  # fmt: skip
    whole = np.zeros((6 * len(seen), 6 * len(seen)))
    for other, result in enumerate(results):
        at = {name: np.flatnonzero(each.poses.results == other) for name, each in seen.items()}
        parts = [gains[name][rows[0]] if len(rows) else np.zeros((6, 6))
                 for name, rows in at.items()]  # fmt: skip
        if not np.any(parts):
            continue
        if result.joint_covariance is None:
            return None
        order = [*result.rig.cameras]
        columns = np.concatenate([np.r_[pose_rows(order.index(name))] for name in seen])
        gain = block_diag(*parts)
        whole += gain @ result.joint_covariance[np.ix_(columns, columns)] @ gain.T
    return whole if np.linalg.eigvalsh(whole)[0] > 0 else None
