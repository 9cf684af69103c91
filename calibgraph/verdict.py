"""Can this result be used? PASS, WARN or FAIL, with the reasons and the thresholds they met.

The thresholds are in the units of the error that a user would suffer, and the same for every rig.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.calibration import Residuals, Status, Verdict
from calibgraph.config import Terms
from calibgraph.covariance import MIN_FRAMES
from calibgraph.errors import CorrespondenceError
from calibgraph.rig import Camera, RelativePose, angle_deg

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

TURNED_WARN_DEG = 45.0
"""A result turned further than this from the guess: the guess was of another convention."""

CONTRAST_WARN, CONTRAST_FAIL = 15.0, 8.0
"""How many chance spreads a matcher's agreement must stand out by. On recorded data wrong results
(over 0.3 deg) had up to 13, right ones from 9 on."""

START_WARN, START_FAIL = 0.25, 0.5
RECALL_WARN, RECALL_FAIL = 0.3, 0.6
FAILED_WARN, FAILED_FAIL = 0.3, 0.7
"""What a learned matcher may leave of a displaced start, what it may undo of it without the image,
and which share of the frames may fail."""

_ORDER: tuple[Status, ...] = ("PASS", "WARN", "FAIL")


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
        turned_deg: angle between the result and the guess.
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
    turned_deg: float
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
        return Verdict("WARN", (few,))
    spread_deg = np.degrees(residuals.sigma_px / camera.intrinsics_px.fx)
    checks = [
        _above("residual spread", spread_deg, SPREAD_WARN_DEG, SPREAD_FAIL_DEG, "deg"),
        _below("inlier share", residuals.inlier_share, INLIERS_WARN, INLIERS_FAIL),
        *_sigma_checks("sigma", evidence.sigmas),
        *_sigma_checks("what the data alone could tell at best", evidence.data_sigmas),
        *(_conflict_check(conflict) for conflict in evidence.conflicts),
    ]
    if evidence.terms in ("stage1", "priors"):
        unchecked = f"the terms {evidence.terms!r} do not fit the correspondences: no error bar"
        checks.append(("WARN", unchecked))
    else:
        checks += _halves_checks(evidence.halves)
    if evidence.turned_deg > TURNED_WARN_DEG:
        turned = (
            f"turned by {evidence.turned_deg:.0f} deg from the guess: is its T_camera_lidar "
            "inverted, or of other axes?"
        )
        checks.append(("WARN", turned))
    if evidence.used < MATCHES_WARN:
        few = f"only {evidence.used} correspondences used, fewer than {MATCHES_WARN}"
        checks.append(("WARN", few))
    if evidence.frames < MIN_FRAMES:
        few = f"only {evidence.frames} frames: too few (under {MIN_FRAMES}) to give an error bar"
        checks.append(("WARN", few))
    if not evidence.converged:
        checks.append(("FAIL", "the optimizer did not converge"))
    return worst_of(checks)


def worst_of(checks: Iterable[tuple[Status, str]]) -> Verdict:
    """The worst status, with the reasons for everything that is not PASS."""
    failed = [check for check in checks if check[0] != "PASS"]
    statuses: list[Status] = [status for status, _ in failed]
    status: Status = max(statuses, key=_ORDER.index, default="PASS")
    return Verdict(status, tuple(reason for _, reason in failed))


@dataclass(frozen=True)
class Matching:
    """What is known of one camera from its matching.

    Attributes:
        moved_deg: how far the last of several rounds turned the camera.
        moved_cm: how far it shifted it.
        contrast: how far the matches' agreement stands out from chance, if the matcher says.
        start_dependence: share of a displaced start that remains in the matches, if it says.
        recall: share of the way back that it finds without the image, if it says.
        failed_share: of the frames.
        systematic_sigmas: what the matcher says of the error that its frames share, per axis:
            rotation [rad], translation [m].
        repeated: that frames repeat each other, if they do.
    """

    moved_deg: float = 0.0
    moved_cm: float = 0.0
    contrast: float | None = None
    start_dependence: float | None = None
    recall: float | None = None
    failed_share: float = 0.0
    systematic_sigmas: tuple[float, float] = (0.0, 0.0)
    repeated: str | None = None


def said_by_matcher(metadata: Mapping[str, Any], camera: str) -> Matching:
    """What a table's metadata says of one camera's matching.

    Raises:
        CorrespondenceError: if it is no number.
    """
    said: dict[str, Any] = {}
    for key in ("contrast", "start_dependence", "recall", "failed_share"):
        of_cameras = metadata.get(key) or {}
        value = of_cameras.get(camera, 0.0) if isinstance(of_cameras, dict) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise CorrespondenceError(
                f"metadata {key!r} must map camera names to numbers, found {of_cameras!r}",
                camera=camera,
            )
        if camera in of_cameras:
            said[key] = float(value)
    return Matching(**said)


def with_matching(verdict: Verdict, matching: Matching) -> Verdict:
    """A camera's verdict, given that of the last solve, with what its matcher knows."""
    what = "matching again still moves it:"
    checks: list[tuple[Status, str]] = [
        *((verdict.status, reason) for reason in verdict.reasons),
        _above(what, matching.moved_deg, MOVING_WARN_DEG, MOVING_FAIL_DEG, "deg"),
        _above(what, matching.moved_cm, MOVING_WARN_CM, MOVING_FAIL_CM, "cm"),
        *_shares_checks(matching),
        *_sigma_checks("the matcher's own error", np.repeat(matching.systematic_sigmas, 3)),
    ]
    if matching.repeated is not None:
        checks.append(("WARN", f"{matching.repeated}: counted as if independent; remove one"))
    if (contrast := matching.contrast) is not None:
        weak, failed = not contrast >= CONTRAST_WARN, not contrast >= CONTRAST_FAIL  # NaN fails
        limit = CONTRAST_FAIL if failed else CONTRAST_WARN
        text = (
            f"image and cloud agree only {contrast:.1f} times better than by chance, less than "
            f"{limit:g}: check the guess (p_camera = T_camera_lidar * p_lidar: its direction, axes "
            "and units), the intrinsics, and that images and clouds belong together"
        )
        checks.append((_grade(weak, failed), text))
    return worst_of(checks)


def _shares_checks(matching: Matching) -> list[tuple[Status, str]]:
    """What a learned matcher does with its start, without its image, and with its frames."""
    limits = (
        (matching.start_dependence, START_WARN, START_FAIL,
         "of a displaced start remains in the matches: the network does not measure here"),
        (matching.recall, RECALL_WARN, RECALL_FAIL,
         "of a displaced start is undone even without the image: the network knows its training's "
         "rig by heart and pulls towards it"),
        (matching.failed_share, FAILED_WARN, FAILED_FAIL, "of the frames failed to be matched"),
    )  # fmt: skip
    return [
        (
            _grade(not share <= warn, not share <= fail),  # NaN fails
            f"an unknown share {text}" if math.isnan(share) else f"{share:.0%} {text}",
        )
        for share, warn, fail, text in limits
        if share is not None
    ]


def rig_verdict(cameras: Mapping[str, Verdict]) -> Verdict:
    """The worst of the cameras, each reason with its camera's name."""
    return worst_of(
        [
            (verdict.status, f"{name}: {reason}")
            for name, verdict in cameras.items()
            for reason in verdict.reasons
        ]
    )


def _halves_checks(halves: tuple[Array, Array] | None) -> list[tuple[Status, str]]:
    if halves is None:
        return [("WARN", "the frames cannot be split into halves to check against each other")]
    one, two = halves
    angle = angle_deg(one[:3, :3] @ two[:3, :3].T)
    distance = 100 * float(np.linalg.norm(_centre(one) - _centre(two)))
    what = "difference between even and odd frames"
    return [
        _above(what, angle, HALVES_WARN_DEG, HALVES_FAIL_DEG, "deg"),
        _above(what, distance, HALVES_WARN_CM, HALVES_FAIL_CM, "cm"),
    ]


def _sigma_checks(what: str, sigmas: Array | None) -> list[tuple[Status, str]]:
    if sigmas is None:
        return []
    rotation, translation = np.degrees(sigmas[:3].max()), 100 * sigmas[3:].max()
    return [
        _above(f"{what}: rotation", rotation, SIGMA_WARN_DEG, SIGMA_FAIL_DEG, "deg"),
        _above(f"{what}: translation", translation, SIGMA_WARN_CM, SIGMA_FAIL_CM, "cm"),
    ]


def _conflict_check(conflict: Conflict) -> tuple[Status, str]:
    pair, sigmas = conflict.pair, conflict.largest
    angle = np.degrees(np.linalg.norm(conflict.difference[:3]))
    distance = 100 * np.linalg.norm(conflict.difference[3:])
    text = (
        f"the relative pose of {pair.a} and {pair.b} differs from what the correspondences say by "
        f"{angle:.2g} deg, {distance:.2g} cm, {sigmas:.3g} sigma: is it p_a = T_a_b * p_b, and are "
        "its sigmas right?"
    )
    return _grade(sigmas > CONFLICT_WARN_SIGMAS, sigmas > CONFLICT_FAIL_SIGMAS), text


def _centre(T_camera_lidar: Array) -> Array:
    """(3,) the camera's centre in the LiDAR frame."""
    centre: Array = -T_camera_lidar[:3, :3].T @ T_camera_lidar[:3, 3]
    return centre


def _above(what: str, value: float, warn: float, fail: float, unit: str) -> tuple[Status, str]:
    weak, failed = not value <= warn, not value <= fail  # NaN fails
    text = f"{what} {value:.3g} {unit} is above {fail if failed else warn:g} {unit}"
    return _grade(weak, failed), text


def _below(what: str, value: float, warn: float, fail: float) -> tuple[Status, str]:
    limit = fail if value < fail else warn
    return _grade(value < warn, value < fail), f"{what} {value:.0%} is below {limit:.0%}"


def _grade(warn: bool, fail: bool) -> Status:
    return "FAIL" if fail else "WARN" if warn else "PASS"
