"""Can this result be used? PASS, WARN or FAIL, with the reasons and the thresholds they met.

The thresholds are in the units of the error that a user would suffer, and the same for every rig.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.calibration import Residuals
from calibgraph.model.config import Terms
from calibgraph.model.findings import MatcherFindings
from calibgraph.model.geometry import angle_deg, camera_center
from calibgraph.model.rig import Camera, RelativePose
from calibgraph.model.verdict import Check, Verdict, above, below, grade
from calibgraph.solver.covariance import MIN_FRAMES
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS

Array = NDArray[np.float64]

SPREAD_WARN_DEG, SPREAD_FAIL_DEG = 0.25, 0.5
"""Residual spread as a viewing angle: half a degree is what a wrong match looks like."""

INLIERS_WARN, INLIERS_FAIL = 0.6, 0.3

HALVES_WARN_DEG, HALVES_FAIL_DEG = 0.2, 0.5
HALVES_WARN_CM, HALVES_FAIL_CM = 6.0, 15.0
"""How far the solutions of the even and of the odd frames may differ."""

SIGMA_WARN_DEG, SIGMA_FAIL_DEG = 0.15, 0.5
SIGMA_WARN_CM, SIGMA_FAIL_CM = 5.0, 15.0

MATCHES_WARN = 50

MOVING_WARN_DEG, MOVING_FAIL_DEG = 0.1, 0.4
MOVING_WARN_CM, MOVING_FAIL_CM = 4.0, 12.0
"""A last round of matching that still moves a camera further has not arrived."""

CONFLICT_WARN_SIGMAS, CONFLICT_FAIL_SIGMAS = 4.0, 8.0
"""How far a relative pose may lie from what the correspondences alone say."""

PULLED_WARN_DEG, PULLED_FAIL_DEG = 0.15, 1.0
PULLED_WARN_CM, PULLED_FAIL_CM = 5.0, 30.0
"""How far priors and relative poses may pull a camera from where its matches see it, beyond what
these leave open."""

SCALE_WARN, SCALE_FAIL = 2.0, 4.0
"""The residuals' spread, by the one that a configured loss scale stands for."""

CONTRAST_WARN, CONTRAST_FAIL = 15.0, 8.0
"""How many chance spreads a matcher's agreement must stand out by. On recorded data wrong results
(over 0.3 deg) had up to 13, right ones from 9 on."""

START_WARN, START_FAIL = 0.25, 0.5
RECALL_WARN, RECALL_FAIL = 0.3, 0.6
FAILED_WARN, FAILED_FAIL = 0.3, 0.7
"""What a learned matcher may leave of a displaced start, what it may undo of it without the image,
and which share of the frames may fail."""


@dataclass(frozen=True, eq=False)
class Conflict:
    """A relative pose of the rig file against what the correspondences alone say.

    Attributes:
        pair: the relative pose.
        difference: (6,) tangent from measured to estimated T_a_b: rotation [rad], translation [m],
            along the axes of b.
        sigmas: (6,) standard deviations expected of it: the measurement's and the estimate's.
    """

    pair: RelativePose
    difference: Array
    sigmas: Array

    @property
    def largest(self) -> float:
        """The largest component of the difference, in its standard deviations."""
        return float(np.abs(self.difference / self.sigmas).max())


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a solve knows of one camera's result.

    Attributes:
        residuals: None if it had no correspondences and was solved through relative poses.
        used: correspondences in the final solve.
        frames: frames that they come from.
        covariance: (6, 6) or None.
        data_sigmas: (6,) what the data alone could tell at best: rotation [rad], translation [m];
            or None.
        halves: (4, 4) T_camera_lidar from the even and from the odd frames, or None.
        conflicts: the relative poses that name this camera.
        pulled: how far priors and relative poses pull it from its own solution [deg, cm]; None if
            not, or within what that leaves open.
        converged: whether the last pass stopped by its tolerance.
        terms: the terms of the objective.
    """

    residuals: Residuals | None
    used: int
    frames: int
    covariance: Array | None
    data_sigmas: Array | None
    halves: tuple[Array, Array] | None
    conflicts: tuple[Conflict, ...]
    pulled: tuple[float, float] | None
    converged: bool
    terms: Terms

    @property
    def sigmas(self) -> Array | None:
        """(6,) standard deviations: rotation [rad], translation [m]; or None."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))


def camera_verdict(camera: Camera, evidence: Evidence) -> Verdict:
    """Judge one camera's result by its evidence."""
    residuals = evidence.residuals
    if residuals is None:
        few = f"{evidence.used} usable correspondences, too few: known only through relative_poses"
        return Verdict((Check("correspondences", "WARN", few, evidence.used),))
    spread_deg = np.degrees(residuals.sigma_px / camera.intrinsics_px.fx)
    checks = [
        above("residual spread", spread_deg, SPREAD_WARN_DEG, SPREAD_FAIL_DEG, "deg"),
        below("inlier share", residuals.inlier_share, INLIERS_WARN, INLIERS_FAIL, "share"),
        *_sigma_checks("sigma", evidence.sigmas),
        *_sigma_checks("what the data alone could tell at best", evidence.data_sigmas),
        *(_conflict_check(conflict) for conflict in evidence.conflicts),
        *_pulled_checks(evidence.pulled),
    ]
    if evidence.terms in ("stage1", "priors"):
        unchecked = f"the terms {evidence.terms!r} do not fit the correspondences: no error bar"
        checks.append(Check("terms", "WARN", unchecked))
    else:
        checks += _halves_checks(evidence.halves)
    converged: Check = Check("convergence", "PASS", "the optimizer converged")
    if not evidence.converged:
        converged = Check("convergence", "FAIL", "the optimizer did not converge")
    enough = [
        below("correspondences used", evidence.used, MATCHES_WARN, 0, ""),
        below("frames", evidence.frames, MIN_FRAMES, 0, "", "too few to give an error bar"),
    ]
    return Verdict((*checks, *enough, converged))


@dataclass(frozen=True)
class Matching:
    """What is known of one camera from its matching.

    Attributes:
        z_score: how far the matches' agreement stands out from chance, if the matcher says.
        start_dependence: share of a displaced start that remains in the matches, if it says.
        recall: share of the way back that it finds without the image, if it says.
        failed_share: of the frames.
        found: the agreement at the pose where its search found the camera, if it searched.
        missed: the best agreement that its search met, if it did not find the camera.
        systematic_sigmas: what the matcher says of the error that its frames share, per axis:
            rotation [rad], translation [m].
    """

    z_score: float | None = None
    start_dependence: float | None = None
    recall: float | None = None
    failed_share: float = 0.0
    found: float | None = None
    missed: float | None = None
    systematic_sigmas: tuple[float, float] = (0.0, 0.0)


def findings_of_camera(findings: MatcherFindings, camera: str) -> Matching:
    """What a matcher reported of one camera."""
    names = ("z_score", "start_dependence", "recall", "failed_share", "found", "missed")
    reported = {name: getattr(findings, name) for name in names}
    return Matching(**{n: values[camera] for n, values in reported.items() if camera in values})


def with_matching(verdict: Verdict, matching: Matching) -> Verdict:
    """A camera's verdict, given that of the last solve, with what its matcher knows."""
    checks = [
        *_search_checks(matching),
        *_shares_checks(matching),
        *_sigma_checks("the matcher's own error", np.repeat(matching.systematic_sigmas, 3)),
    ]
    if matching.z_score is not None:
        advice = (
            "image and cloud hardly agree better than by chance; check the guess (p_camera = "
            "T_camera_lidar * p_lidar: its direction, axes and units), the intrinsics, and that "
            "images and clouds belong together"
        )
        checks.append(
            below("contrast of image and cloud", matching.z_score, CONTRAST_WARN, CONTRAST_FAIL,
                  "chance spreads", advice)
        )  # fmt: skip
    return verdict.and_also(checks)


def _search_checks(matching: Matching) -> list[Check]:
    """Whether a matcher's search found the camera, if it searched."""
    name, words = "search", "contrast {:.1f} of image and cloud"
    if matching.missed is not None:
        text = (
            f"no pose within the matcher's range explains the images (best {words}): check the "
            "guess, the intrinsics and the pairing, widen --search-deg and --search-m, or give "
            "more frames from more places"
        )
        return [Check(name, "FAIL", text.format(matching.missed), matching.missed)]
    if matching.found is not None:
        text = f"{words} where the rounds began"
        return [Check(name, "PASS", text.format(matching.found), matching.found)]
    return []


def _shares_checks(matching: Matching) -> list[Check]:
    """What a learned matcher does with its start, without its image, and with its frames."""
    limits = (
        ("start dependence", matching.start_dependence, START_WARN, START_FAIL,
         "of a displaced start remains in the matches: the network does not measure here"),
        ("recall", matching.recall, RECALL_WARN, RECALL_FAIL,
         "of a displaced start is undone even without the image: the network knows its training's "
         "rig by heart and pulls towards it"),
        ("failed frames", matching.failed_share, FAILED_WARN, FAILED_FAIL,
         "of the frames failed to be matched"),
    )  # fmt: skip
    checks = []
    for name, share, warn, fail, text in limits:
        if share is not None:
            status = grade(not share <= warn, not share <= fail)  # NaN fails
            found = "an unknown share" if math.isnan(share) else f"{share:.0%}"
            checks.append(Check(name, status, f"{found} {text}", share, warn, fail, "share"))
    return checks


def _halves_checks(halves: tuple[Array, Array] | None) -> list[Check]:
    name = "difference between even and odd frames"
    if halves is None:
        text = "the frames cannot be split into halves to check against each other"
        return [Check(name, "WARN", text)]
    one, two = halves
    angle = angle_deg(one[:3, :3] @ two[:3, :3].T)
    distance = 100 * float(np.linalg.norm(camera_center(one) - camera_center(two)))
    return [
        above(name, angle, HALVES_WARN_DEG, HALVES_FAIL_DEG, "deg"),
        above(name, distance, HALVES_WARN_CM, HALVES_FAIL_CM, "cm"),
    ]


def _sigma_checks(what: str, sigmas: Array | None) -> list[Check]:
    if sigmas is None:
        return []
    rotation, translation = float(np.degrees(sigmas[:3].max())), 100 * float(sigmas[3:].max())
    return [
        above(f"{what}: rotation", rotation, SIGMA_WARN_DEG, SIGMA_FAIL_DEG, "deg"),
        above(f"{what}: translation", translation, SIGMA_WARN_CM, SIGMA_FAIL_CM, "cm"),
    ]


def _conflict_check(conflict: Conflict) -> Check:
    pair, sigmas = conflict.pair, conflict.largest
    angle = np.degrees(np.linalg.norm(conflict.difference[:3]))
    distance = 100 * np.linalg.norm(conflict.difference[3:])
    text = (
        f"the relative pose of {pair.a} and {pair.b} differs from what the correspondences say by "
        f"{angle:.2g} deg, {distance:.2g} cm, {sigmas:.3g} sigma"
    )
    status = grade(sigmas > CONFLICT_WARN_SIGMAS, sigmas > CONFLICT_FAIL_SIGMAS)
    if status != "PASS":
        text += ": is it p_a = T_a_b * p_b, are its sigmas right, are two cameras' images swapped?"
    return Check(
        f"relative pose of {pair.a} and {pair.b}", status, text,
        sigmas, CONFLICT_WARN_SIGMAS, CONFLICT_FAIL_SIGMAS, "sigma",
    )  # fmt: skip


def _pulled_checks(pulled: tuple[float, float] | None) -> list[Check]:
    degrees, centimetres = pulled or (0.0, 0.0)
    name = "joint solution, from the camera's own"
    advice = "priors or relative poses pull it; are they right?"
    return [
        above(name, degrees, PULLED_WARN_DEG, PULLED_FAIL_DEG, "deg", advice),
        above(name, centimetres, PULLED_WARN_CM, PULLED_FAIL_CM, "cm", advice),
    ]


def assumed_spread_check(residuals: Residuals, loss_scale_px: float) -> Check:
    """The residuals' spread, by the one that a configured loss scale stands for."""
    return above(
        "residual spread by the assumed one",
        CAUCHY_SCALE_SIGMAS * residuals.sigma_px / loss_scale_px, SCALE_WARN, SCALE_FAIL, "times",
        "the matches are worse than loss_scale_px (delta) takes them for",
    )  # fmt: skip
