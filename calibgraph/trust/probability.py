"""The probability that a result is off by more than the tolerance, from which verdicts are cut.

Three ways to be off. Grossly, in a way that checks notice: a logistic model of how bad the worst
sign of an error is, and single checks besides, which can only grow as a check gets worse. By a
wrong lens, or by a pose that a search found by chance: checks whose value is a probability. And by
the error bar itself, if it is wide beside the tolerance. The last two hold as far as they did in
the cases fitted to. The weights are fitted by ``tools.probability``, on results that
were made wrong on purpose and right ones, and kept in ``probability.json``, with how they were got.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from scipy.special import expit, gammainc, gammaincc

from calibgraph.arrays import Array
from calibgraph.model.verdict import (
    ABOUT_THE_DATA,
    COMMON_ERROR,
    FAIL_ABOVE,
    FLAT_EVIDENCE,
    IMAGES_ELSEWHERE,
    PASS_BELOW,
    WENT_ON,
    Check,
    ErrorProbability,
    Status,
    Verdict,
)
from calibgraph.trust.lens_parameter import LENS_KINDS, advise_together

TABLES, STRUCTURE = "tables", "structure"
"""The models: of correspondences from any source; of runs of the matcher."""

CHANCE = "chance"
"""Kind of the check whose value is the probability that a search finds as much by chance."""

WORST = "worst check"
"""Stands beside the kinds of checks for the worst of them."""

_DIRECTIONS = 400  # over which the error bar is integrated: to 1e-3 of a probability's logarithm


def judge(
    checks: Sequence[Check], beyond: float, tolerance: tuple[float, float], model: str
) -> Verdict:
    """The verdict of one camera's result, by its checks and by its posterior.

    By that, ``beyond`` is the probability of an error beyond the tolerance [deg, cm]; the model is
    TABLES or STRUCTURE.
    """
    of_checks, odds = probability_of_checks(checks, model), _models()[model]["bar_odds"]
    probability = ErrorProbability(of_checks, beyond, *tolerance, bar_odds=odds)
    return Verdict(tuple(advise_together(checks)), probability)


def probability_of_checks(checks: Sequence[Check], model: str) -> float:
    """The probability that a result is wrong, by its checks; 1 if one is decisive."""
    if any(check.decisive for check in checks):
        return 1.0
    fitted = _models()[model]
    kinds = [check.kind or check.name for check in checks]
    worst = worst_severities(zip(kinds, (check.severity for check in checks), strict=True))
    parts = contributions(worst, fitted["weights"], fitted["other"])
    grossly = float(expit(fitted["intercept"] + sum(parts.values())))
    if any(value > 1.0 for kind, value in worst.items() if kind not in {*fitted["seen"], WORST}):
        grossly = max(grossly, PASS_BELOW)  # no case had it: what it says is not known
    values = [(k, check.status, check.value) for k, check in zip(kinds, checks, strict=True)]
    by_values = float(fitted["value_reliability"]) * probability_by_values(values)
    return float(1.0 - (1.0 - grossly) * (1.0 - by_values))


def probability_by_values(values: Sequence[tuple[str, Status, float | None]]) -> float:
    """By (kind, status, value) of the checks whose value is one: a wrong lens, a find by chance.

    Of the lens the worst parameter counts; one that is a WARN counts as one, whatever its value.
    """
    most: dict[Status, float] = {"FAIL": 1.0, "WARN": FAIL_ABOVE, "PASS": PASS_BELOW}
    of_lens = [min(v or 0.0, most[status]) for kind, status, v in values if kind in LENS_KINDS]
    by_chance = [value or 0.0 for kind, _, value in values if kind == CHANCE]
    chance = min(max(0.0, *by_chance), 1.0) if by_chance else 0.0  # tables may state anything
    return 1.0 - (1.0 - max([0.0, *of_lens])) * (1.0 - chance)


def worst_severities(checks: Iterable[tuple[str, float]]) -> dict[str, float]:
    """The worst of (kind, severity) pairs per kind of check, and of all, as ``WORST``.

    Checks of the lens and of chance are left out, whose value is a probability, and those that are
    no sign of an error. The worst of all is of checks that can show an error: what counts data is
    in the error bar. Where the probability to find as much by chance is known, checks that count
    data are left out of all.
    """
    worst: dict[str, float] = {}
    for kind, severity in checks:
        worst[kind] = max(severity, worst.get(kind, 0.0))
    left_out = {*LENS_KINDS, COMMON_ERROR, CHANCE, FLAT_EVIDENCE, WENT_ON, IMAGES_ELSEWHERE}
    left_out |= ABOUT_THE_DATA if CHANCE in worst else frozenset()
    kept = {kind: severity for kind, severity in worst.items() if kind not in left_out}
    signs = (value for kind, value in kept.items() if kind not in ABOUT_THE_DATA)
    return {**kept, WORST: max(signs, default=0.0)}


def contributions(
    severities: Mapping[str, float], weights: Mapping[str, Sequence[float]], other: Sequence[float]
) -> dict[str, float]:
    """Per kind of check, its contribution to the log odds; never negative."""
    each = np.array([weights.get(kind, other) for kind in severities]).reshape(-1, 3)
    sums = (steps(np.array([*severities.values()])) * each).sum(axis=1)
    return dict(zip(severities, sums.tolist(), strict=True))


def steps(severities: Array) -> Array:
    """(n, 3): how far each of (n,) severities is through PASS, WARN and FAIL, 0 to 1."""
    return np.clip(severities[:, None] - np.arange(3.0), 0.0, 1.0)


def probability_beyond(covariance: Array | None, tolerance: tuple[float, float]) -> float:
    """The probability that an error of this covariance exceeds the tolerance; 0 without one.

    Of a (6, 6) covariance [rad, m] and a tolerance [deg, cm]; rotation and distance count as
    independent.
    """
    if covariance is None:
        return 0.0
    centre = np.zeros(3)
    rotation = probability_outside(centre, covariance[:3, :3], np.radians(tolerance[0]))
    shift = probability_outside(centre, covariance[3:, 3:], tolerance[1] / 100)
    return rotation + shift - rotation * shift


def probability_outside(mean: Array, covariance: Array, radius: float) -> float:
    """P(|x| > radius) of a Gaussian x with (3,) mean and (3, 3) covariance.

    Over directions from the mean, of the chi distribution before and behind the ball.
    """
    variances, axes = np.linalg.eigh(covariance)
    rays = _directions() @ (axes * np.sqrt(np.maximum(variances, 1e-24))).T  # zero, or rounded
    squares, towards = np.sum(rays**2, axis=1), rays @ mean
    inside = towards**2 - squares * (mean @ mean - radius**2)
    chord = np.sqrt(np.maximum(inside, 0.0))
    near, far = (np.maximum(end, 0.0) / squares for end in (-towards - chord, -towards + chord))
    outside = gammainc(1.5, near**2 / 2) + gammaincc(1.5, far**2 / 2)  # three degrees of freedom
    return float(np.mean(outside))


@cache
def _directions() -> Array:
    """(n, 3) unit vectors, evenly over the sphere."""
    number = np.arange(_DIRECTIONS) + 0.5
    height = 1 - 2 * number / _DIRECTIONS
    angle = np.pi * (1 + np.sqrt(5)) * number
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


@cache
def _models() -> dict[str, Any]:
    text = files(__package__).joinpath("probability.json").read_text("utf-8")
    return dict(json.loads(text)["models"])
