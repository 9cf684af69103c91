"""Whether two cameras' relative pose from their images agrees with the calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import (
    pose_difference,
    relative_covariance,
    relative_transform,
    twist_between,
)
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check
from calibgraph.solver.pair_refinement import PairFit
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.thresholds import threshold

ONE_POSE_DEG, ONE_POSE_CM = 0.1, 1.0
"""Housings do not fit closer; two results of one device's images end as near."""

BLAME_SIGMAS = 1.0
"""Factor by which one camera of a pair must disagree more with its other neighbours than the other
one with its own, to be taken for the one that is wrong."""


@dataclass(frozen=True)
class PairAgreement:
    """The relative pose of two cameras from images against the calibration.

    Attributes:
        a: the one camera.
        b: the other.
        degrees: between the two T_b_a.
        centimetres: between their camera centres.
        sigmas: the largest difference along an axis of b, in standard deviations; NaN where the
            calibration has no covariance.
        residual_px: robust spread of the residuals at the calibration.
        least_px: the same where the images place the cameras.
        matches: features on surfaces that were used.
    """

    a: str
    b: str
    degrees: float
    centimetres: float
    sigmas: float
    residual_px: float
    least_px: float
    matches: int


def pair_agreement_checks(evidence: Evidence) -> dict[str, list[Check]]:
    """Whether the correspondences place the cameras relative to each other as the images do."""
    own = evidence.of_correspondences
    if evidence.solution.camera_matches is None or evidence.solution.before_pairs is None:
        return {}
    mount = own.solution.marginals.mount
    rig = own.solution.rig.moved_to(mount.T_camera_lidar)
    covariance = own.solution.marginals.known_or_prior(mount.covariance)
    found = [
        pair_agreement(rig, fit, covariance)
        for fit in own.pair_fits
        if own.fitted_blocks.keys() >= {fit.a, fit.b}
    ]
    return {
        name: [check_agreement(one, name, found) for one in found if name in (one.a, one.b)]
        for name in own.cameras
    }


def one_pose_checks(evidence: Evidence) -> dict[str, list[Check]]:
    """Cameras that end at one pose, unless the rig ties them there: have they one device's images?

    Nothing else in a result shows it: images have the pose of the device that took them.
    """
    rig, checks = evidence.solution.rig, dict[str, list[Check]]()
    T = evidence.solution.T_camera_lidar
    tied = {frozenset((one.a, one.b)) for one in rig.relative_poses if _is_one_pose(one.T_a_b)}
    for a, b in combinations(T, 2):
        if not _is_one_pose(relative_transform(T[a], T[b])) or {a, b} in tied:
            continue
        degrees, centimetres = pose_difference(T[a], T[b])
        text = (
            f"{a} and {b} end {degrees:.2g} deg, {centimetres:.2g} cm from each other: have they "
            "the images of one device? If they are mounted so, state it in relative_poses"
        )
        for name in (a, b):
            check = Check("cameras at one pose", "WARN", text, kind="one_pose")
            checks.setdefault(name, []).append(check)
    return checks


def _is_one_pose(T_a_b: Array) -> bool:
    degrees, centimetres = pose_difference(T_a_b, np.eye(4))
    return degrees <= ONE_POSE_DEG and centimetres <= ONE_POSE_CM


def check_agreement(found: PairAgreement, camera: str, all_found: Sequence[PairAgreement]) -> Check:
    """The check of one camera of a pair, which other pairs may show to be the other's fault."""
    row, name = threshold("pair_agreement"), f"relative pose of {found.a} and {found.b} by images"
    status, other = row.grade(found.sigmas), found.b if camera == found.a else found.a
    text = (
        f"images and correspondences contradict each other on the pose of {found.a} to {found.b} "
        f"by {found.degrees:.2g} deg, {found.centimetres:.2g} cm, {found.sigmas:.3g} sigma"
    )
    own, of_other = (_elsewhere(one, found, all_found) for one in (camera, other))
    if status == "PASS" or not of_other > max(row.warn, own + BLAME_SIGMAS):
        text += "" if status == "PASS" else f": {row.advice}"
        return row.describe(found.sigmas, status, text, name=name)
    text += f": by its other pairs ({of_other:.3g} sigma) it is {other} that is wrong"
    return row.describe(own, "WARN", text, name=name)


def _elsewhere(camera: str, pair: PairAgreement, found: Sequence[PairAgreement]) -> float:
    """Sigmas by which a camera disagrees with the cameras outside a pair; 0 without others."""
    others = [one for one in found if one is not pair and camera in (one.a, one.b)]
    return max((one.sigmas for one in others), default=0.0)


def pair_agreement(rig: Rig, fit: PairFit, covariance: Array | None) -> PairAgreement:
    """A pair by its images against a calibration.

    Args:
        rig: mounts at the calibration, which has not used the images' matches.
        fit: with A held near it.
        covariance: (6 N, 6 N) of the calibration, in the rig's order; None if unknown.
    """
    before = rig.T_camera_lidar
    T_b_a = relative_transform(before[fit.b], before[fit.a])
    degrees, centimetres = pose_difference(fit.T_b_a, T_b_a)
    sigmas = float("nan")
    if covariance is not None:
        first, second = (tuple(rig.cameras).index(name) for name in (fit.a, fit.b))
        own = relative_covariance(covariance, first, second, T_b_a)
        variances = np.diag(own) + np.diag(fit.covariance)
        sigmas = float(np.max(np.abs(twist_between(fit.T_b_a, T_b_a)) / np.sqrt(variances)))
    residual, least = (
        max(term.sigma_px(T) for term in fit.terms) for T in (before, fit.T_camera_lidar)
    )
    return PairAgreement(fit.a, fit.b, degrees, centimetres, sigmas, residual, least, fit.features)
