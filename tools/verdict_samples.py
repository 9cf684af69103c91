"""Cases of ``verdicts`` as the model of the probability sees them, and how it is judged."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import expit

from benchmarks.accuracy.cases import UNDETECTABLE
from benchmarks.accuracy.ledger import Record
from benchmarks.accuracy.verdicts import STATUSES, class_of
from benchmarks.tables import Table
from calibgraph.model.verdict import TOLERANCE, Check, ErrorProbability, Verdict
from calibgraph.trust.probability import (
    contributions,
    probability_beyond,
    probability_by_values,
    worst_severities,
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
    """

    level: str
    kind: str
    severities: dict[str, float]
    by_bar: float
    by_values: float
    off: bool
    right: bool
    statuses: dict[str, str]


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


BINS = (0.0, 0.002, 0.005, 0.02, 0.1, 0.2, 0.5, 0.9, 1.0)
FALSE_PASS = (0.005, 0.05)
"""Shares of wrong results that may be PASS, at which the right ones that are PASS are counted."""


def status_of(sample: Sample, doubt: ErrorProbability) -> str:
    """The verdict, by the probability that it is off."""
    checks = tuple(Check(kind, status, "") for kind, status in sample.statuses.items())
    return Verdict(checks, doubt).status


def judged(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> list[Table]:
    """Tables: verdicts by class; how well the probability holds, and separates."""
    clear = [sample for sample in samples if sample.kind not in AMBIGUOUS]
    without = f"{name}, without {', '.join(AMBIGUOUS)}"
    return [
        cuts(name, model, samples), reliability(without, model, clear),
        discrimination(without, model, clear),
    ]  # fmt: skip


def cuts(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> Table:
    """How many results of each class get each verdict."""
    classes = ["off" if s.off else "right" if s.right else "between" for s in samples]
    statuses = [*map(status_of, samples, doubts(model, samples))]
    found = Counter(zip(classes, statuses, strict=True))
    heads = [(c, s) for c in ("off", "between", "right") for s in STATUSES]
    columns = tuple(": ".join(head) for head in heads)
    return Table(f"{name}: results", columns, (tuple(str(found[head]) for head in heads),))


def reliability(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> Table:
    """How often results are off by their probability, and its mean squared error."""
    p, off = probabilities(model, samples), np.array([s.off for s in samples])
    count, rows = shares(samples), []
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        inside = (p >= low) & ((p < high) | (high == 1))
        if inside.any():
            mean, found = (np.average(v[inside], weights=count[inside]) for v in (p, off))
            rows.append((f"{low:g} to {high:g}", str(inside.sum()), f"{mean:.4f}", f"{found:.4f}"))
    brier = np.average((p - off) ** 2, weights=count)
    return Table(f"{name}: how often results are off; mean squared error {brier:.4f}",
                 ("probability", "results", "its mean", "off"), tuple(rows))  # fmt: skip


def discrimination(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> Table:
    """The share of right results that are PASS at each share of wrong ones in ``FALSE_PASS``.

    The limit is moved to where the results that are off allow it: of the probability, and of the
    probability where no check says that data are missing (the verdict).
    """
    off, right = (np.array([getattr(s, which) for s in samples]) for which in ("off", "right"))
    probability = probabilities(model, samples)
    never = [status_of(s, ErrorProbability(0.0)) != "PASS" for s in samples]
    scores = {"probability": probability, "verdict": np.where(never, 1.0, probability)}
    rows = [
        (how, *(f"{_passed(score[off], score[right], share):.0%}" for share in FALSE_PASS))
        for how, score in scores.items()
    ]
    columns = ("right results that PASS", *(f"false PASS {share:.1%}" for share in FALSE_PASS))
    counts = f"{off.sum()} results off, {right.sum()} right"
    return Table(f"{name}: discrimination, {counts}", columns, tuple(rows))


def _passed(off: Array, right: Array, share: float) -> float:
    """The share of right scores below the limit under which no more than a share of the off are."""
    return float(np.mean(right < np.sort(off)[int(share * len(off))]))
