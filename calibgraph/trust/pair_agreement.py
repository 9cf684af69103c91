"""Whether two cameras' relative pose from their images agrees with that of the calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.camera_matches import CameraMatches
from calibgraph.model.config import Config
from calibgraph.model.geometry import (
    pose_difference,
    pose_rows,
    relative_covariance,
    relative_transform,
    twist_between,
)
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Check
from calibgraph.solver.camera_pairs import PairTerm, pair_terms
from calibgraph.solver.pair_refinement import covariance_of_fit, fit_pair
from calibgraph.trust.evidence import Evidence
from calibgraph.trust.shared_error import PAIR_SIGMA_M, PAIR_SIGMA_RAD, shared_covariance
from calibgraph.trust.thresholds import threshold
from factors import EpipolarBlock, pose_sigmas

Array = NDArray[np.float64]

_HELD_RAD, _HELD_M = np.radians(0.1), 0.02  # the first camera, if its covariance is unknown


@dataclass(frozen=True)
class PairAgreement:
    """The relative pose of two cameras from images against that of a calibration.

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
    matches, own = evidence.solution.camera_matches, evidence.of_correspondences
    if matches is None or evidence.solution.before_pairs is None:
        return {}
    solution, covariance = own.solution, _covariance(own)
    checks: dict[str, list[Check]] = {name: [] for name in own.cameras}
    for found in pair_agreements(solution.solved_rig, matches, covariance, solution.config):
        if own.fitted_blocks.keys() >= {found.a, found.b}:
            for name in (found.a, found.b):
                checks[name].append(_check_agreement(found))
    return checks


def _covariance(evidence: Evidence) -> Array:
    """(6 N, 6 N) of a solution; with too few frames, of the error that all frames share."""
    if evidence.joint_covariance is not None:
        return evidence.joint_covariance
    shared = shared_covariance(evidence.findings, evidence.solution.T_camera_lidar)
    held = pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M) ** 2
    return shared if shared.any() else np.diag(np.tile(held, len(evidence.cameras)))


def _check_agreement(found: PairAgreement) -> Check:
    row, name = threshold("pair_agreement"), f"relative pose of {found.a} and {found.b} by images"
    status = row.grade(found.sigmas)
    text = (
        f"the {name} differs from that by the correspondences by {found.degrees:.2g} deg, "
        f"{found.centimetres:.2g} cm, {found.sigmas:.3g} sigma"
    )
    text += "" if status == "PASS" else f": {row.advice}"
    return row.describe(found.sigmas, status, text, name=name)


def pair_agreements(
    rig: Rig, matches: CameraMatches, covariance: Array | None, config: Config
) -> tuple[PairAgreement, ...]:
    """Per pair of cameras with enough features on surfaces, in the table's order.

    Args:
        rig: at the calibration, which has not used the matches.
        matches: with the surfaces at the calibration.
        covariance: (6 N, 6 N) of the calibration, in the rig's order; None if unknown.
        config: the loss.
    """
    found = []
    for a, b in matches.pairs():
        terms = [
            term
            for term in pair_terms(rig, matches.of_pair(a, b), config)
            if not isinstance(term.block, EpipolarBlock)
        ]
        if terms:
            found.append(_agreement(rig, (a, b), terms, covariance))
    return tuple(found)


def _agreement(
    rig: Rig, names: tuple[str, str], terms: list[PairTerm], covariance: Array | None
) -> PairAgreement:
    """Fit the pair with A near its place and B free, and compare."""
    a, b = names
    joint, before = covariance, rig.T_camera_lidar
    first, second = (tuple(rig.cameras).index(name) for name in names)
    sigmas_a = pose_sigmas(rotation_rad=_HELD_RAD, translation_m=_HELD_M)
    held = np.diag(sigmas_a**2) if joint is None else joint[pose_rows(first), pose_rows(first)]
    after = fit_pair(names, terms, before, held)
    poses = [relative_transform(T[b], T[a]) for T in (after, before)]
    degrees, centimetres = pose_difference(*poses)
    sigmas = float("nan")
    if joint is not None:
        own = relative_covariance(joint, first, second, poses[1])
        floor = pose_sigmas(rotation_rad=PAIR_SIGMA_RAD, translation_m=PAIR_SIGMA_M)
        of_fit = relative_covariance(covariance_of_fit(names, terms, after, held), 0, 1, poses[0])
        variances = np.diag(own) + np.diag(of_fit) + floor**2
        sigmas = float(np.max(np.abs(twist_between(*poses)) / np.sqrt(variances)))
    residual, least = (max(term.sigma_px(T) for term in terms) for T in (before, after))
    count = sum(len(term.frame) for term in terms)
    return PairAgreement(a, b, degrees, centimetres, sigmas, residual, least, count)
