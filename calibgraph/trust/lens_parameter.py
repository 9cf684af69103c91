"""The probability that a lens parameter is wrong, by the posterior of a free lens.

A parameter is in standard deviations of a lens that was calibrated with a target, or of those that
the rig states.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from itertools import product
from operator import mul

import numpy as np
from scipy.special import expit, logit, ndtr, softmax

from calibgraph.arrays import Array
from calibgraph.graph.lens import LensVariable
from calibgraph.model.config import LensPart
from calibgraph.model.lens import LensSigmas
from calibgraph.model.rig import Camera
from calibgraph.model.verdict import TOLERANCE, Check
from calibgraph.solver.columns import Marginal
from calibgraph.trust.thresholds import LENS_WRONG, LENS_WRONG_SHARE, threshold
from factors import Columns
from factors.columns import ASPECT, CENTRE_X, CENTRE_Y, FOCAL


class Free(IntEnum):
    """What is free, by number: parameters of a lens."""

    FOCAL, RADIAL, CENTRE_X, CENTRE_Y, ASPECT = range(5)


ASPECT_RATIO = "aspect ratio"
"""No lens has it wrong by much; it is checked, and not estimated."""
NAMES = {
    "focal length": ("focal", "a focal length {} % longer", "a focal length {} % shorter"),
    "distortion": ("distortion", "a k1 larger by {}", "a k1 smaller by {}"),
    "principal point": ("centre", "a principal point off by ({}) px", ""),
    ASPECT_RATIO: (None, "a ratio fx / fy {} % larger", "a ratio fx / fy {} % smaller"),
}
"""Parameters that are judged: what ``--estimate`` calls them, and a lens with more or less."""
TIME = "time offset"
_WORDS = {**NAMES, TIME: ("offset", "images taken {} ms later", "images taken {} ms earlier")}

RESIDUALS, IMAGES = "residuals over the image", "images"
"""What an estimate is by."""

KINDS = {
    (by, name): prefix + name.replace(" ", "_")
    for by, prefix in ((RESIDUALS, "lens_"), (IMAGES, ""))
    for name in _WORDS
}
"""Kinds of the checks."""
LENS_KINDS = frozenset(KINDS.values())
_PART_OF = {kind: part for (_, name), kind in KINDS.items() if (part := _WORDS[name][0])}
_ESTIMATE = re.compile(r"(run with --estimate )[a-z,]+((?: --[a-z-]+ [\w.]+)?)")

_NAMES = FOCAL, "k1", CENTRE_X, CENTRE_Y, ASPECT
_PARTS: tuple[LensPart, ...] = "focal", "centre", "distortion"
_ASPECT_SIGMA = 0.002
_MOST_SIGMAS = 1e6  # enough for any probability
_TINY = float(np.finfo(float).tiny)


def lens_variable(camera: Camera) -> LensVariable:
    """The lens of a camera with the parameters that are checked, at its calibration."""
    all_of = LensVariable.of(camera, _PARTS, LensSigmas.calibrated(camera)).free
    sigmas = dict(zip(all_of.parameters, all_of.sigmas, strict=True)) | {ASPECT: _ASPECT_SIGMA}
    free = Columns(camera.lens, _NAMES, tuple(sigmas[name] for name in _NAMES))
    return LensVariable(camera, free, np.zeros(len(free)))


@dataclass(frozen=True, eq=False)
class LensParameter:
    """An estimate of one lens parameter together with the extrinsic.

    Attributes:
        name: one of ``NAMES``, or ``TIME``.
        values: (m,) change, in standard deviations of a calibrated lens.
        sigmas: (m,) their standard deviations, frames as clusters.
        twist: (6,) rotation [rad] and translation [m] by which the camera moves.
        units: (m,) of the values: relative, pixels, of k1, or seconds.
    """

    name: str
    values: Array
    sigmas: Array
    twist: Array
    units: Array

    @staticmethod
    def of(name: str, units: Array, freed: Marginal, error: float = 0.0) -> LensParameter:
        """Of a fit whose last unknowns have these units; others may be free before them.

        ``error`` is a further one of each value, in standard deviations of a calibrated lens.
        """
        count = len(units)
        values, covariance = _beside_others(name, freed, len(freed.values) - count)
        twist, sigmas = freed.compensating[:, -count:] @ values, np.sqrt(np.diag(covariance))
        return LensParameter(name, values, np.hypot(sigmas, error), twist, units)

    @cached_property
    def moved(self) -> tuple[float, float]:
        """How far the camera turns [deg] and its centre moves [cm]."""
        twist = self.twist.tolist()
        return math.degrees(math.hypot(*twist[:3])), 100 * math.hypot(*twist[3:])

    @cached_property
    def size(self) -> float:
        """The length of the values."""
        return math.hypot(*self.values.tolist())

    @cached_property
    def sigma(self) -> float:
        """Its standard deviation."""
        size = max(self.size, _TINY)
        along = (value / size for value in self.values.tolist())
        return max(math.hypot(*map(mul, along, self.sigmas.tolist())), _TINY)

    @cached_property
    def evidence(self) -> float:
        """Log likelihood ratio of a wrong value against none at all, to compare parameters by."""
        if not math.isfinite(self.sigma):  # not determined
            return 0.0
        return self._log_density(LENS_WRONG) - self._log_density(0.0)

    def probability(
        self,
        tolerance: tuple[float, float] = TOLERANCE,
        *,
        blame: float = 1.0,
        most_unseen: float = 0.0,
    ) -> float:
        """That the parameter is wrong and displaces the camera beyond a tolerance [deg, cm].

        What the estimate adds to it: Bayes' rule, of two kinds of lens parameters, usual ones and
        wrong ones. Their errors are normally distributed with mean zero; wrong ones are rare. What
        usual ones do to the pose is in its error bar. Where one of several was wrong, the others
        look wrong, too, if each is set free alone: ``blame`` is how likely it is this one. What was
        probable before and the data do not show counts up to ``most_unseen``.

        An aspect ratio that no lens has counts even if the camera moves little when it is set free:
        matches from rounds have followed it. At the default tolerance any size of it counts. At a
        wider one it counts if half of it, as an angle, exceeds what the tolerance adds to the
        default rotation.
        """
        if not math.isfinite(self.sigma):  # not determined
            return 0.0
        moves = max(moved / most for moved, most in zip(self.moved, tolerance, strict=True))
        counted = self.size / moves if moves else math.inf
        if self.name == ASPECT_RATIO:
            wider = min(one / usual for one, usual in zip(tolerance, TOLERANCE, strict=True)) - 1
            counted = math.radians(TOLERANCE[0]) * max(wider, 0.0) / (self.units[0] / 2)
        wrong, share = LENS_WRONG, LENS_WRONG_SHARE
        odds = logit(share) + self._log_density(wrong) - self._log_density(1.0)
        is_wrong, gain = float(expit(odds)), wrong / math.hypot(self.sigma, wrong)
        after = _share_beyond(counted, gain**2 * self.size, gain * self.sigma)
        shown = is_wrong * blame * after - share * _share_beyond(counted, 0.0, wrong)
        return max(shown, min(is_wrong * after, most_unseen), 0.0)

    def _log_density(self, spread: float) -> float:
        """The log density of the values among parameters that spread so."""
        total = math.hypot(self.sigma, spread)
        return -(min(self.size / total, _MOST_SIGMAS) ** 2) / 2 - math.log(total)

    def describe(self) -> str:
        """The lens that would be right, in words."""
        _, more, less = _WORDS[self.name]
        units = self.units * (100 if "%" in more else 1000 if "ms" in more else 1)
        values = units * (np.abs(self.values) if less else self.values)
        numbers = ", ".join(map(_with_sigma, values, units * self.sigmas))
        return (less if less and self.values[0] < 0 else more).format(numbers)


def _beside_others(name: str, freed: Marginal, others: int) -> tuple[Array, Array]:
    """(m,) values and (m, m) covariance of unknowns beside others, the first of a fit.

    A focal length that is 1 % off is no less rare beside a distortion than alone. So the other
    unknowns have the errors of lens parameters, too: the mean and the covariance over all of their
    combinations of usual and wrong. Not beside an aspect ratio: a wrong fy alone is a wrong focal
    length, too, which stays free.
    """
    first, last = slice(others), slice(others, None)
    values, covariance = freed.values, freed.covariance
    if not others or name == ASPECT_RATIO or not np.isfinite(covariance).all():
        return values[last], covariance[last, last]
    wrong = np.array([*product((False, True), repeat=others)])
    spreads = np.where(wrong, LENS_WRONG, 1.0)
    total = covariance[first, first] + spreads[:, :, None] ** 2 * np.eye(others)
    gain, misfit = (
        np.linalg.solve(total, each) for each in (covariance[first, last], values[first, None])
    )
    odds = logit(LENS_WRONG_SHARE) * wrong.sum(axis=1)
    fits = values[first] @ misfit[..., 0].T + np.linalg.slogdet(total).logabsdet
    weights = softmax(odds - fits / 2)
    means = values[last] - values[first] @ gain
    within = covariance[last, last] - covariance[last, first] @ gain
    mean = weights @ means
    apart = (means - mean)[:, :, None] * (means - mean)[:, None]
    return mean, np.tensordot(weights, within + apart, axes=1)


def _share_beyond(size: float, mean: float, sigma: float) -> float:
    """The probability that a normally distributed number is larger than a size."""
    return float(ndtr((mean - size) / sigma) + ndtr((-mean - size) / sigma))


def _with_sigma(value: float, sigma: float) -> str:
    """A number with its standard deviation, in two digits of that."""
    if not 0 < sigma < math.inf:
        return f"{value:.2g} +- unknown"
    decimals = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"


def check_parameter(
    found: LensParameter,
    by: str,
    tolerance: tuple[float, float] = TOLERANCE,
    options: str = "",
    *,
    blame: float = 1.0,
    unseen: bool = False,
) -> Check:
    """Whether a lens parameter is wrong, by RESIDUALS or IMAGES: the value is the probability.

    For a tolerance [deg, cm]; ``options`` are those that its estimate needs, " --interval-s 0.1".
    ``unseen``: whether what the data do not show counts.
    """
    row = threshold("lens")  # what is not seen blames no lens
    probability = found.probability(tolerance, blame=blame, most_unseen=row.warn * unseen)
    deg, cm = found.moved
    text = f"by the {by}, {found.describe()}; the camera would move by {deg:.2g} deg, {cm:.2g} cm"
    advice = "correct the time stamps" if found.name == TIME else row.advice
    if part := _WORDS[found.name][0]:
        advice += f"; or run with --estimate {part}{options}"
    name = f"{found.name} by the {by}: {row.name}"
    check = row.check(probability, text, name=name, advice=advice)
    return replace(check, kind=KINDS[by, found.name])


def advise_together(checks: Sequence[Check]) -> list[Check]:
    """The checks of a camera; of several parameters that look wrong, the advice is one.

    A wrong parameter makes others look wrong, since matches follow it. To estimate one of those
    alone would leave the camera where it is, with an error bar that does not hold.
    """
    look_wrong = {check.kind for check in checks if check.status != "PASS"}
    parts = {_PART_OF[kind] for kind in look_wrong & _PART_OF.keys()}
    if len(parts) < 2:  # noqa: PLR2004
        return list(checks)
    all_parts = ",".join(["lens", *(parts & {"offset"})])
    found = (_ESTIMATE.search(check.text) for check in checks if check.status != "PASS")
    options = next((match[2] for match in found if match and match[2]), "")
    return [
        replace(check, text=_ESTIMATE.sub(rf"\1{all_parts}{options}", check.text))
        if check.kind in _PART_OF
        else check
        for check in checks
    ]
