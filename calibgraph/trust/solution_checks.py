"""Checks of an estimate by its own numbers: residuals, sigmas, relative poses, counts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.verdict import COMMON_ERROR, Check
from calibgraph.solver.conflicts import Conflict
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS
from calibgraph.trust.estimate import Estimate
from calibgraph.trust.evidence import Checks, Evidence
from calibgraph.trust.thresholds import threshold
from factors.free_lens import CLOCK


def estimate_checks(evidence: Evidence) -> Checks:
    """The checks of every camera's estimate."""
    return {name: check_estimate(evidence.estimate(name)) for name in evidence.cameras}


def check_estimate(estimate: Estimate) -> list[Check]:
    """The checks of one camera's estimate, from a batch solve or while driving."""
    excluded, used = estimate.excluded, f"{estimate.used} usable correspondences, too few"
    kind = "excluded" if excluded else ""
    if estimate.held:
        text = (
            f"{'excluded by the settings' if excluded else used}, and nothing ties it to another "
            "camera: it is left at its guess"
        )
        if not excluded:
            text += (
                "; check that its images show something sharp, that the cloud lies where "
                "T_camera_lidar looks, and its name"
            )
        return [Check("correspondences", "FAIL", text, estimate.used, kind=kind)]
    if not estimate.has_matches:
        text = (
            f"{'excluded by the settings' if excluded else used}: determined by other cameras "
            "alone, through relative_poses, which have to be right, or what they see in common"
        )
        return [Check("correspondences", "WARN", text, estimate.used, kind=kind)]
    return [check for function in ESTIMATE_CHECKS for check in function(estimate)]


def sigma_checks(estimate: Estimate) -> list[Check]:
    """The error bar, and its lower bound if every correspondence were independent."""
    return [
        *check_sigmas("sigma", estimate.sigmas, estimate.tolerance),
        *check_sigmas(
            "lower bound of sigma by the data alone", estimate.data_sigmas, estimate.tolerance
        ),
    ]


def check_sigmas(what: str, sigmas: Array | None, tolerance: tuple[float, float]) -> list[Check]:
    """Standard deviations against their limits.

    Args:
        what: of what, in words.
        sigmas: (6,) rotation [rad], translation [m]; None if unknown.
        tolerance: of the user [deg, cm].
    """
    if sigmas is None:
        return []
    rotation_deg, translation_cm = (
        float(np.degrees(sigmas[:3].max())),
        100 * float(sigmas[3:].max()),
    )
    return [
        threshold("sigma_rotation", tolerance).check(rotation_deg, name=f"{what}, rotation"),
        threshold("sigma_translation", tolerance).check(
            translation_cm, name=f"{what}, translation"
        ),
    ]


def common_error_checks(estimate: Estimate) -> list[Check]:
    """The check that the error that all frames share is stated and part of the error bar."""
    if not estimate.scatter_only or estimate.sigmas is None:
        return []
    text = (
        "scatter only: the table states no error that its frames share, so that the true error may "
        "be many times the error bar"
    )
    return [Check("common error", "WARN", text, kind=COMMON_ERROR)]


def flat_evidence_checks(evidence: Evidence) -> Checks:
    """Whether the images leave a pose more open than the matches, where images are known."""
    return {name: [check] for name, check in evidence.flatness.items()}


def relative_pose_checks(estimate: Estimate) -> list[Check]:
    """Whether the rig's relative poses agree with the correspondences."""
    return [_check_relative_pose(conflict) for conflict in estimate.conflicts]


def _check_relative_pose(conflict: Conflict) -> Check:
    row, pair, sigmas = threshold("relative_pose"), conflict.pair, conflict.largest
    degrees = np.degrees(np.linalg.norm(conflict.difference[:3]))
    centimetres = 100 * np.linalg.norm(conflict.difference[3:])
    status, name = row.grade(sigmas), f"relative pose of {pair.a} and {pair.b}"
    text = (
        f"the correspondences contradict the measured {name} by "
        f"{degrees:.2g} deg, {centimetres:.2g} cm, {sigmas:.3g} sigma"
    )
    text += "" if status == "PASS" else f": {row.advice}"
    return row.describe(sigmas, status, text, name=name)


def terms_checks(estimate: Estimate) -> list[Check]:
    """Whether the terms use the correspondences."""
    if estimate.terms not in ("stage1", "priors"):
        return []
    text = f"the terms {estimate.terms!r} do not fit the correspondences: no error bar"
    return [Check("terms", "WARN", text)]


def count_checks(estimate: Estimate) -> list[Check]:
    """Whether there are enough correspondences and frames."""
    return [
        threshold("correspondences_used").check(estimate.used),
        threshold("frames").check(estimate.frames),
    ]


def lens_prior_checks(estimate: Estimate) -> list[Check]:
    """How far each estimated parameter of lens and clock lies from what the rig states."""
    row, checks = threshold("lens_prior"), []
    for one in estimate.lens:
        name = f"{one.name}: {row.name}"
        kind = "time_prior" if one.name in CLOCK else row.key
        check = replace(row.check(one.prior_sigmas, name=name), kind=kind)
        text = check.text if check.status == "PASS" else f"{check.text} ({one.change})"
        checks.append(replace(check, text=text))
    return checks


def convergence_checks(estimate: Estimate) -> list[Check]:
    """Whether the optimizer stopped by its tolerance."""
    if estimate.converged:
        return [Check("convergence", "PASS", "the optimizer converged")]
    return [Check("convergence", "FAIL", "the optimizer did not converge")]


ESTIMATE_CHECKS: tuple[Callable[[Estimate], list[Check]], ...] = (
    sigma_checks,
    common_error_checks,
    relative_pose_checks,
    terms_checks,
    count_checks,
    lens_prior_checks,
    convergence_checks,
)
"""Checks that a batch solve and the tracker share."""


def outlier_frame_checks(evidence: Evidence) -> Checks:
    """How many frames were left out because they lie far from where most frames agree."""
    counts = evidence.solution.counts
    return {
        name: [
            threshold("outlier_frames").check(
                counts[name]["outlier_frames"] / max(1, counts[name]["frames"])
            )
        ]
        for name in evidence.fitted_blocks
    }


def repeated_frame_checks(evidence: Evidence) -> Checks:
    """How many frames count as part of another one, where there are any."""
    checks = {}
    for name, counts in evidence.solution.counts.items():
        repeated = counts.get("repeated_frames", 0)
        if repeated:
            share = repeated / (repeated + counts["frames"])
            checks[name] = [threshold("repeated_frames").check(share)]
    return checks


def assumed_spread_checks(evidence: Evidence) -> Checks:
    """The residuals' spread over the one that a configured loss scale stands for."""
    loss_scale_px = evidence.solution.config.loss_scale_px
    if loss_scale_px is None:
        return {}
    row = threshold("assumed_spread")
    return {
        name: [row.check(CAUCHY_SCALE_SIGMAS * evidence.residuals[name].sigma_px / loss_scale_px)]
        for name in evidence.fitted_blocks
    }


def bootstrap_checks(evidence: Evidence) -> Checks:
    """Whether the reported covariance is as large as the bootstrap's, if there is one."""
    row, checks = threshold("bootstrap_sigma"), {}
    for name, bootstrap in evidence.bootstrap.items():
        reported = evidence.scatter_of(name)
        if reported is not None:
            ratio = float(np.sqrt(np.max(np.diag(bootstrap) / np.diag(reported))))
            checks[name] = [row.check(ratio)]
    return checks


def prior_share_checks(evidence: Evidence) -> Checks:
    """How much of a result comes from priors and relative poses."""
    row = threshold("prior_share")
    return {name: [row.check(share)] for name, share in evidence.prior_shares.items()}
