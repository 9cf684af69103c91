"""The probability that a lens parameter is wrong, by an estimate of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit, ndtr

from calibgraph.model.verdict import FAIL_ABOVE, PASS_BELOW, TOLERANCE, Check, Status
from calibgraph.trust.thresholds import limit, threshold

Array = NDArray[np.float64]

NAMES = ("focal length", "distortion", "principal point", "aspect ratio", "skew")
SHAPES = NAMES[3:]
"""Those that no lens has wrong by much."""

ESTIMATED_AS = {
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


@dataclass(frozen=True, eq=False)
class LensParameter:
    """An estimate of one lens parameter together with the extrinsic.

    Attributes:
        name: "focal length", "principal point", "distortion", "aspect ratio" or "skew".
        values: (k,) estimates: relative change of the focal length; shift of the principal point
            [px]; relative radial displacement at one focal length from the centre; relative change
            of fx / fy (of images: of its logarithm, as of the focal length's); change of the skew,
            in parts of fx.
        sigmas: (k,) their standard deviations, frames as clusters.
        unit: (k,) of the values, for ``size`` and ``sigma``: the focal lengths [px] of a principal
            point, else one.
        twist: (6,) rotation [rad] and translation [m] by which the camera moves.
    """

    name: str
    values: Array
    sigmas: Array
    unit: Array
    twist: Array

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
        """The length of the values: relative, or in focal lengths."""
        return float(np.linalg.norm(self.values / self.unit))

    @property
    def sigma(self) -> float:
        """Its standard deviation."""
        along = self.values / self.unit / max(self.size, np.finfo(float).tiny)
        of_size = float(np.linalg.norm(along * self.sigmas / self.unit))
        return max(of_size, np.finfo(float).tiny)

    @property
    def significance(self) -> str:
        """The size in its standard deviations, in words."""
        return "unknown" if math.isnan(self.sigma) else f"{self.size / self.sigma:.2g}"

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
        usual = _Posterior(self.size, self.sigma, limit("lens_usual"))
        wrong = _Posterior(self.size, self.sigma, limit("lens_wrong"))
        share = limit("lens_wrong_share")
        is_wrong = float(expit(logit(share) + wrong.log_evidence - usual.log_evidence))
        after, before = (1.0, 1.0) if self.name in SHAPES else wrong.beyond(tolerated)
        if_wrong = max(is_wrong * after - share * before, 0.0)
        after, before = usual.beyond(tolerated)
        return if_wrong + (1 - is_wrong) * max(after - before, 0.0)


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


def check_parameter(found: LensParameter, by: str, better: str) -> Check:
    """Whether a lens parameter is wrong: the value of the check is the probability.

    Args:
        found: its estimate.
        by: RESIDUALS or IMAGES.
        better: the lens that would be right, in words.
    """
    row, probability = threshold("lens"), found.probability
    status = row.grade(probability)
    text = (
        f"by the {by}, {better} ({found.significance} sigma) would move the camera by "
        f"{found.moved_deg:.2g} deg, {found.moved_cm:.2g} cm"
    )
    if status != "PASS":
        text += f"; {row.advice}"
        if found.name in ESTIMATED_AS:
            text += f"; or run with --estimate {ESTIMATED_AS[found.name]}"
    name = f"{found.name} by the {by}: {row.name}"
    check = row.describe(probability, status, text, name=name)
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
