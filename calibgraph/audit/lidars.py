"""Deployed poses of LiDARs against a recording: each is measured again, from where it is deployed.

A LiDAR is compared as a camera is: its motion in its own axes, T_deployed_now = exp(xi). Poses of a
result have error bars, which count beside those of the measurement.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.audit.judgement import (
    FALSE_ALARM_RATE,
    LIDAR_AXES,
    SINGLE_LIDAR,
    Limits,
    Measured,
    detectable,
    judge_deviation,
)
from calibgraph.audit.result import CameraAudit
from calibgraph.errors import CalibrationError, RigError
from calibgraph.io.dataset import Dataset
from calibgraph.model.config import Config
from calibgraph.model.geometry import invert, twist_between
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress
from calibgraph.vehicle.lidars import PLACE_FREEDOM, LidarPoses
from calibgraph.vehicle.rig import LidarResult, calibrate_rig_lidars

_LEAST_FREEDOM = 3.0  # of one place, where the size is a prior
_UNUSABLE = ("lidar_matched", "lidar_start")  # kinds of checks


def measure_lidars(
    deployed: Rig, data: Dataset, config: Config, tolerance: Array, *, sensors: int,
    progress: Progress,
) -> tuple[Measured, LidarPoses | None]:  # fmt: skip
    """Measure the LiDARs of a rig again, and compare them with where they are deployed.

    Args:
        deployed: with a pose of each.
        data: its frames have their clouds.
        config: of the verdict of what is measured.
        tolerance: (2,) of a turn [rad] and a shift [m].
        sensors: number of all that are compared, over which false alarms are shared.
        progress: called as the work goes on.

    Returns:
        The comparison of those but the base; their poses, None if they could not be measured.

    Raises:
        RigError: if a LiDAR has no pose.
        DatasetError: if no instant has all clouds.
    """
    names, known = deployed.other_lidars, deployed.T_base_lidar
    if missing := [name for name in names if name not in known]:
        raise RigError(
            f"lidars.{missing[0]}: has no T_base_lidar, so that there is no pose to compare; "
            "calibrate it first"
        )
    rig = deployed.model_copy(update={"vehicle": None})
    try:
        found = calibrate_rig_lidars(data, rig, config, progress=progress)
    except CalibrationError as error:
        if error.__class__ is not CalibrationError:  # of the data
            raise
        audits = {name: CameraAudit("CANNOT TELL", str(error)) for name in names}
        return Measured(audits), None
    T_lidar_base = [invert(known[name]) for name in names]
    now = found.poses.T_base_lidar
    deviations = [
        twist_between(T, invert(now[name])) for name, T in zip(names, T_lidar_base, strict=True)
    ]
    covariance = _covariance(found, deployed)
    freedom = freedom_of_places(found.poses.places, len(names))
    limits = Limits.of(freedom, FALSE_ALARM_RATE / sensors, tolerance)
    audits = {}
    for row, name in enumerate(names):
        own = covariance[6 * row : 6 * row + 6, 6 * row : 6 * row + 6]
        status, reason = judge_deviation(deviations[row], own, limits, axes=LIDAR_AXES)
        if doubt := _doubt(found, name):
            status, reason = "CANNOT TELL", doubt
        elif status == "WRONG" and sensors == 1:
            reason += SINGLE_LIDAR
        sigma = np.sqrt(np.diag(own))
        audits[name] = CameraAudit(
            status, reason, deviations[row], sigma, detectable(sigma, limits.confident)
        )
    return Measured(audits, deviations, covariance, T_lidar_base), found.poses


def freedom_of_places(places: int, lidars: int) -> float:
    """Degrees of freedom of the covariance of LiDARs from so many places."""
    return max(PLACE_FREEDOM + 3.0 * lidars * (places - 1), _LEAST_FREEDOM)


def _covariance(found: LidarResult, deployed: Rig) -> Array:
    """(6 k, 6 k) of the deviations: of the measurement and, if it is known, of what is deployed."""
    names, joint = deployed.other_lidars, found.poses.joint_covariance.copy()
    for row, name in enumerate(names):
        own = (deployed.lidars or {})[name].covariance
        if own is not None:
            joint[6 * row : 6 * row + 6, 6 * row : 6 * row + 6] += own
    turns = [deployed.T_base_lidar[name][:3, :3].T for name in names for _ in range(2)]
    to_own = block_diag(*turns)
    return np.asarray(to_own @ joint @ to_own.T)


def _doubt(found: LidarResult, name: str) -> str:
    """Why a measurement cannot be used; empty if it can."""
    checks = found.verdicts[name].checks
    return "; ".join(
        check.text
        for check in checks
        if (check.kind or check.name) in _UNUSABLE and check.status != "PASS"
    )
