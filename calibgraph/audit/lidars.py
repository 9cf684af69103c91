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
from calibgraph.pipeline import find_lidars
from calibgraph.progress import Progress
from calibgraph.rounds import AnyMatcher
from calibgraph.vehicle.lidars import PLACE_FREEDOM
from calibgraph.vehicle.rig import LidarResult

_LEAST_FREEDOM = 3.0  # of one place, where the size is a prior
_UNUSABLE = ("lidar_matched", "lidar_start")  # kinds of checks


def measure_lidars(
    deployed: Rig, data: Dataset, config: Config, tolerance: Array, *,
    matcher: AnyMatcher = "structure", progress: Progress,
) -> tuple[Dataset, Measured]:  # fmt: skip
    """Measure the LiDARs of a rig again, and compare them with where they are deployed.

    Args:
        deployed: with a pose of each.
        data: its frames have their clouds.
        config: of the verdict of what is measured.
        tolerance: (2,) of a turn [rad] and a shift [m].
        matcher: of cameras, which place LiDARs that share too little.
        progress: called as the work goes on.

    Returns:
        The dataset, its clouds joined where cameras gain; and the LiDARs but the base.

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
    rig, sensors = deployed.model_copy(update={"vehicle": None}), len(deployed.cameras) + len(names)
    try:
        data, found, _ = find_lidars(data, rig, matcher, config, progress=progress)
    except CalibrationError as error:
        if error.__class__ is not CalibrationError:  # of the data
            raise
        audits = {name: CameraAudit("CANNOT TELL", str(error)) for name in names}
        return data, Measured(audits)
    T_lidar_base = [invert(known[name]) for name in names]
    now = found.poses.T_base_lidar
    deviations = [
        twist_between(T, invert(now[name])) for name, T in zip(names, T_lidar_base, strict=True)
    ]
    turns = [deployed.T_base_lidar[name][:3, :3].T for name in names for _ in range(2)]
    to_own = block_diag(*turns)
    covariance, by_errors = (
        to_own @ _covariance(found, deployed) @ to_own.T,
        to_own @ found.poses.root,
    )
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
    return data, Measured(audits, deviations, covariance, by_errors, T_lidar_base)


def freedom_of_places(places: int, lidars: int) -> float:
    """Degrees of freedom of the covariance of LiDARs from so many places."""
    return max(PLACE_FREEDOM + 3.0 * lidars * (places - 1), _LEAST_FREEDOM)


def _covariance(found: LidarResult, deployed: Rig) -> Array:
    """(6 k, 6 k) of all poses: of the measurement and, if it is known, of what is deployed."""
    lidars, nothing = deployed.lidars or {}, np.zeros((6, 6))
    bars = [lidars[name].covariance for name in deployed.other_lidars]
    known = [nothing if bar is None else bar for bar in bars]
    return np.asarray(found.poses.joint_covariance + block_diag(*known))


def _doubt(found: LidarResult, name: str) -> str:
    """Why a measurement cannot be used; empty if it can."""
    checks = found.verdicts[name].checks
    return "; ".join(
        check.text
        for check in checks
        if (check.kind or check.name) in _UNUSABLE and check.status != "PASS"
    )
