"""Cases of ``verdicts`` as the model of the probability sees them: a sample per camera."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from benchmarks.accuracy.cases import UNDETECTABLE
from benchmarks.accuracy.ledger import Record
from benchmarks.accuracy.verdicts import STATUSES, class_of
from calibgraph.model.verdict import TOLERANCE, ErrorProbability
from calibgraph.trust.probability import (
    WORST,
    contributions,
    probability_beyond,
    probability_by_values,
    worst_severities,
    worst_sign,
)

Array = np.ndarray

SHARE_OFF = 0.1
AMBIGUOUS = ("two_poses_45",)
"""Kinds in which the matches cannot tell which of two extrinsics is right: a FAIL is wanted,
although the result is right. They take no part in the fit nor in how well the probability holds;
verdicts are counted with them."""


@dataclass(frozen=True, eq=False)
class Sample:
    """One camera of one run.

    Attributes:
        level: "table" or "data".
        kind: of the case.
        severities: per kind of check, and of the worst.
        by_bar: the probability that its error bar alone allows.
        by_values: that of checks whose value is one: a wrong lens, a pose found by chance.
        off: whether it is off.
        right: whether it is right: well within the tolerance.
        statuses: per kind of check, the worst.
        worst: the largest severity of all checks.
    """

    level: str
    kind: str
    severities: dict[str, float]
    by_bar: float
    by_values: float
    off: bool
    right: bool
    statuses: dict[str, str]
    worst: float

    @property
    def vote(self) -> str:
        """The worst status of its checks, as verdicts were made before there was a probability."""
        return max(self.statuses.values(), key=STATUSES.index, default="PASS")


def samples_of(records: Iterable[Record]) -> list[Sample]:
    """The results of cases that data can tell from right ones, without those decided anyway."""
    return [
        _sample(record, camera)
        for record in records if record["kind"] not in UNDETECTABLE
        for camera in record.get("cameras", {}).values()
        if not any(decisive for *_, decisive in camera["checks"])
    ]  # fmt: skip


def _sample(record: Record, camera: Record) -> Sample:
    checks, which = camera["checks"], class_of(camera)
    return Sample(
        level=record["level"],
        kind=record["kind"],
        severities=worst_severities((kind, severity) for kind, _, _, severity, _ in checks),
        by_bar=_beyond(camera),
        by_values=probability_by_values([(kind, of, value) for kind, of, value, *_ in checks]),
        off=which == "off",
        right=which == "right",
        statuses=_worst_statuses(checks),
        worst=max((severity for *_, severity, _ in checks), default=0.0),
    )


def _beyond(camera: Record) -> float:
    """By the posterior; by the error bar alone in records that lack it."""
    if camera.get("beyond") is not None:
        return float(camera["beyond"])
    rows = camera["covariance"]
    return probability_beyond(None if rows is None else np.array(rows), TOLERANCE)


def _worst_statuses(checks: Sequence[Sequence[Any]]) -> dict[str, str]:
    ordered = sorted(checks, key=lambda check: STATUSES.index(check[1]))
    return {kind: status for kind, status, *_ in ordered}


def drop(sample: Sample, kinds: Collection[str]) -> Sample:
    """The sample without some kinds of checks."""
    left_out = {*kinds, WORST}
    kept = {kind: value for kind, value in sample.severities.items() if kind not in left_out}
    return replace(sample, severities={**kept, WORST: worst_sign(kept)})


def doubts(model: dict[str, Any], samples: Sequence[Sample]) -> list[ErrorProbability]:
    """Of every sample."""
    weights, other = model["weights"], model["other"]
    grossly = [
        expit(model["intercept"] + sum(contributions(s.severities, weights, other).values()))
        for s in samples
    ]
    of_values, of_bar = model["value_reliability"], model["bar_odds"]
    return [
        ErrorProbability(1 - (1 - p) * (1 - of_values * s.by_values), s.by_bar, bar_odds=of_bar)
        for p, s in zip(grossly, samples, strict=True)
    ]


def probabilities(model: dict[str, Any], samples: Sequence[Sample]) -> Array:
    """(n,) of every sample."""
    return np.array([doubt.probability for doubt in doubts(model, samples)])


def shares(samples: Sequence[Sample]) -> Array:
    """(n,) what each sample counts, so that one result in ten is off."""
    off = np.array([sample.off for sample in samples])
    return np.where(off, SHARE_OFF / off.mean(), (1 - SHARE_OFF) / (1 - off.mean()))
