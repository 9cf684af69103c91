"""The probability that a lens parameter is wrong, by the posterior of a free lens.

A parameter is in standard deviations of a lens that was calibrated with a target, or of those that
the rig states. Half of a skew, which no lens of a rig has, is a rotation about the axis; the other
half is a field of displacements of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, ndtr

from calibgraph.graph.lens import LensSigmas, LensVariable
from calibgraph.model.config import LensPart
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW, TOLERANCE, Check, Status
from calibgraph.solver.linear_fit import Freed
from calibgraph.trust.thresholds import limit, threshold
from factors import FreeLens
from factors.free_lens import ASPECT, CENTRE_X, CENTRE_Y, FOCAL

Array = NDArray[np.float64]

NAMES = ("focal length", "distortion", "principal point", "aspect ratio", "skew")
SHAPES = NAMES[3:]
"""Those that no lens has wrong by much."""

_FREE = (FOCAL, "k1", CENTRE_X, CENTRE_Y, ASPECT)
FOCAL_NUMBER, RADIAL_NUMBER, X_NUMBER, Y_NUMBER, ASPECT_NUMBER, SKEW_NUMBER = range(6)
_SKEW_SIGMA = 0.002  # in parts of fx

_PARTS: dict[str, LensPart] = {
    "focal length": "focal",
    "distortion": "distortion",
    "principal point": "centre",
    "aspect ratio": "aspect",
}
"""Parts of the lens that ``--estimate`` names; it has no skew."""

RESIDUALS, IMAGES = "residuals over the image", "images"
"""What an estimate is by."""

KINDS = {
    RESIDUALS: {name: f"lens_{name.replace(' ', '_')}" for name in NAMES},
    IMAGES: {name: name.replace(" ", "_") for name in NAMES},
}
"""Kinds of the checks."""
LENS_KINDS = frozenset(kind for kinds in KINDS.values() for kind in kinds.values())

_ANYTHING = 1e6  # standard deviation of a parameter that is not determined
_MOST_SIGMAS = 1e6  # enough for any probability
_WORDS = {
    "focal length": ("a focal length {} % longer", "a focal length {} % shorter"),
    "distortion": ("a k1 larger by {}", "a k1 smaller by {}"),
    "aspect ratio": ("a ratio fx / fy {} % larger", "a ratio fx / fy {} % smaller"),
    "skew": ("a skew of {} % of fx", "a skew of -{} % of fx"),
}


def lens_variable(camera: Camera) -> LensVariable:
    """The lens of a camera with the parameters that are checked, at its calibration."""
    all_of = LensVariable.of(camera, _PARTS.values(), LensSigmas.calibrated(camera)).free
    sigmas = dict(zip(all_of.parameters, all_of.sigmas, strict=True))
    free = FreeLens(camera.lens, _FREE, tuple(sigmas[name] for name in _FREE))
    return LensVariable(camera, free, np.zeros(len(free)))


def lens_fields_px(camera: Camera, points_lidar_m: Array) -> Array:
    """(6, 2, n) derivatives of the pixels of points (n, 3) by the parameters, last by the skew."""
    lens, T, k = lens_variable(camera), camera.T_camera_lidar, camera.intrinsics_px
    points = points_lidar_m @ T[:3, :3].T + T[:3, 3]
    fields = np.empty((1 + len(lens.free), 2, len(points)))
    lens.free.fill_columns(camera.lens, points, fields[:-1])
    off_centre = fields[FOCAL_NUMBER] / lens.free.sigmas[FOCAL_NUMBER]
    fields[-1] = 0.5 * _SKEW_SIGMA * off_centre[::-1] * [[k.fx / k.fy], [k.fy / k.fx]]
    return fields


@dataclass(frozen=True, eq=False)
class LensParameter:
    """An estimate of one lens parameter together with the extrinsic.

    Attributes:
        name: "focal length", "principal point", "distortion", "aspect ratio" or "skew".
        values: (m,) change, in standard deviations of a calibrated lens.
        sigmas: (m,) their standard deviations, frames as clusters.
        twist: (6,) rotation [rad] and translation [m] by which the camera moves.
        units: (m,) of the values, as people state them: relative, pixels, or of k1.
    """

    name: str
    values: Array
    sigmas: Array
    twist: Array
    units: Array

    @staticmethod
    def of(name: str, camera: Camera, freed: Freed, numbers: tuple[int, ...]) -> LensParameter:
        """Of a fit of the parameters with these numbers."""
        units = np.array([*lens_variable(camera).free.sigmas, _SKEW_SIGMA])[[*numbers]]
        twist = freed.compensating @ freed.values
        return LensParameter(name, freed.values, freed.sigmas, twist, units)

    @property
    def moved_deg(self) -> float:
        """How far the camera turns."""
        return float(np.degrees(np.linalg.norm(self.twist[:3])))

    @property
    def moved_cm(self) -> float:
        """How far the camera's centre moves."""
        return 100 * float(np.linalg.norm(self.twist[3:]))

    @property
    def size(self) -> float:
        """The length of the values."""
        return float(np.linalg.norm(self.values))

    @property
    def sigma(self) -> float:
        """Its standard deviation."""
        along = self.values / max(self.size, np.finfo(float).tiny)
        return max(float(np.linalg.norm(along * self.sigmas)), np.finfo(float).tiny)

    @property
    def probability(self) -> float:
        """That the parameter is wrong and displaces the camera by more than users tolerate.

        What the estimate adds to it: Bayes' rule, of two kinds of lens parameters, usual ones and
        wrong ones. Their errors are normally distributed with mean zero; wrong ones are rare. An
        aspect ratio or skew as no lens has it counts also if set free it moves the camera little:
        matches from rounds have followed it.
        """
        if not self.sigma < _ANYTHING:
            return 0.0
        moves = max(self.moved_deg / TOLERANCE[0], self.moved_cm / TOLERANCE[1])
        tolerated = self.size / moves if moves else math.inf
        usual = _Posterior(self.size, self.sigma, 1.0)
        wrong = _Posterior(self.size, self.sigma, limit("lens_wrong"))
        share = limit("lens_wrong_share")
        is_wrong = float(expit(logit(share) + wrong.log_evidence - usual.log_evidence))
        after, before = (1.0, 1.0) if self.name in SHAPES else wrong.beyond(tolerated)
        if_wrong = max(is_wrong * after - share * before, 0.0)
        after, before = usual.beyond(tolerated)
        return if_wrong + (1 - is_wrong) * max(after - before, 0.0)

    def describe(self) -> str:
        """The lens that would be right, in words."""
        factor = 100 if self.name in ("focal length", *SHAPES) else 1
        values, sigmas = factor * self.units * self.values, factor * self.units * self.sigmas
        if self.name == "principal point":
            each = map(_with_sigma, values, sigmas)
            return f"a principal point off by ({', '.join(each)}) px"
        more, less = _WORDS[self.name]
        return (more if values[0] > 0 else less).format(_with_sigma(abs(values[0]), sigmas[0]))


def _with_sigma(value: float, sigma: float) -> str:
    """A number with its standard deviation: as many digits as that has."""
    if not 0 < sigma < math.inf:
        return f"{value:.2g} +- unknown"
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"


@dataclass(frozen=True)
class _Posterior:
    """Of a normally distributed number with mean zero that was measured.

    Attributes:
        measured: its measurement.
        sigma: of the measurement's error.
        spread: of the number.
    """

    measured: float
    sigma: float
    spread: float

    @property
    def total(self) -> float:
        """Standard deviation of the measurement."""
        return math.hypot(self.sigma, self.spread)

    @property
    def log_evidence(self) -> float:
        """Of the measurement, up to a constant."""
        sigmas = min(self.measured / self.total, _MOST_SIGMAS)
        return -(sigmas**2) / 2 - math.log(self.total)

    def beyond(self, size: float) -> tuple[float, float]:
        """The probabilities that the number is larger than this, with and without measurement."""
        gain = self.spread / self.total
        mean, deviation = gain**2 * self.measured, gain * self.sigma
        after = ndtr((mean - size) / deviation) + ndtr((-mean - size) / deviation)
        return float(after), float(2 * ndtr(-size / self.spread))


def check_parameter(found: LensParameter, by: str) -> Check:
    """Whether a lens parameter is wrong: the value of the check is the probability.

    Args:
        found: its estimate.
        by: RESIDUALS or IMAGES.
    """
    row, probability = threshold("lens"), found.probability
    status = row.grade(probability)
    text = (
        f"by the {by}, {found.describe()}; the camera would move by {found.moved_deg:.2g} deg, "
        f"{found.moved_cm:.2g} cm"
    )
    if status != "PASS":
        text += f": {row.advice}"
        if found.name in _PARTS:
            text += f"; or run with --estimate {_PARTS[found.name]}"
    check = row.describe(probability, status, text, name=f"{found.name} by the {by}: {row.name}")
    return replace(check, kind=KINDS[by][found.name])


def probability_of_lens(values: Iterable[tuple[str, Status, float | None]]) -> float:
    """The probability that the worst of the lens parameters is wrong.

    Args:
        values: kind, status and value of checks. One that is a WARN counts as one, whatever its
            value.
    """
    most: dict[Status, float] = {"FAIL": 1.0, "WARN": FAIL_ABOVE, "PASS": PASS_BELOW}
    of_lens = [(status, value) for kind, status, value in values if kind in LENS_KINDS]
    return max((min(value or 0.0, most[status]) for status, value in of_lens), default=0.0)
