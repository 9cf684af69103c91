"""How well the probability of being off holds, and how well it separates off from right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.tables import Table
from calibgraph.model.verdict import Check, ErrorProbability, Verdict
from tools.verdict_samples import AMBIGUOUS, Sample, doubts, probabilities, shares

Array = np.ndarray

VOTE = {"PASS": 0.005, "WARN": 0.1, "FAIL": 0.9}
"""The probabilities that a vote stands for, to compare it with."""
BINS = (0.0, 0.002, 0.005, 0.02, 0.1, 0.2, 0.5, 0.9, 1.0)
FALSE_PASS = (0.005, 0.05)
"""Shares of wrong results that may be PASS, at which the right ones that are PASS are counted."""


def status_of(sample: Sample, doubt: ErrorProbability) -> str:
    """The verdict, by the probability that it is off."""
    checks = tuple(Check(kind, status, "") for kind, status in sample.statuses.items())
    return Verdict(checks, doubt).status


def judged(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> list[Table]:
    """Tables: verdicts by probability and by vote; how well the probability holds."""
    clear = [sample for sample in samples if sample.kind not in AMBIGUOUS]
    return [
        cuts(name, model, samples),
        *reliability(f"{name}, without {', '.join(AMBIGUOUS)}", model, clear),
        discrimination(f"{name}, without {', '.join(AMBIGUOUS)}", model, clear),
    ]


def cuts(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> Table:
    """How many results of each class get each verdict."""
    classes = ["off" if s.off else "right" if s.right else "between" for s in samples]
    judged, rows = [*map(status_of, samples, doubts(model, samples))], []
    for how, statuses in (("vote", [s.vote for s in samples]), ("probability", judged)):
        found = Counter(zip(classes, statuses, strict=True))
        rows.append((how, *(str(found[c, s]) for c in ("off", "between", "right") for s in VOTE)))
    columns = ("", *(f"{c}: {s}" for c in ("off", "between", "right") for s in VOTE))
    return Table(f"{name}: results", columns, tuple(rows))


def reliability(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> list[Table]:
    """The mean squared error of the probability, and how often results are off by it."""
    p, off = probabilities(model, samples), np.array([s.off for s in samples])
    votes = np.array([VOTE[s.vote] for s in samples])
    count = shares(samples)
    brier = [f"{np.average((values - off) ** 2, weights=count):.4f}" for values in (votes, p)]
    rows = []
    for low, high in zip(BINS[:-1], BINS[1:], strict=True):
        inside = (p >= low) & ((p < high) | (high == 1))
        if inside.any():
            mean, found = (np.average(v[inside], weights=count[inside]) for v in (p, off))
            row = (inside.sum(), f"{mean:.4f}", f"{found:.4f}")
            rows.append((f"{low:g} to {high:g}", *map(str, row)))
    return [
        Table(f"{name}: mean squared error of the probability", ("results", "vote", "probability"),
              ((str(len(p)), *brier),)),
        Table(f"{name}: how often results are off", ("probability", "results", "its mean", "off"),
              tuple(rows)),
    ]  # fmt: skip


def discrimination(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> Table:
    """The share of right results that are PASS at each share of wrong ones in ``FALSE_PASS``.

    The limit is moved to where the results that are off allow it: of the largest severity of all
    checks (the vote), of the probability, and of the probability where no check says that data are
    missing (the verdict).
    """
    off, right = (np.array([getattr(s, which) for s in samples]) for which in ("off", "right"))
    scores = {
        "vote": np.array([s.worst for s in samples]),
        "probability": probabilities(model, samples),
    }
    never = [status_of(s, ErrorProbability(0.0)) != "PASS" for s in samples]
    scores["verdict"] = np.where(never, 1.0, scores["probability"])
    rows = [
        (how, *(f"{_passed(score[off], score[right], share):.0%}" for share in FALSE_PASS))
        for how, score in scores.items()
    ]
    columns = ("right results that PASS", *(f"false PASS {share:.1%}" for share in FALSE_PASS))
    counts = f"{off.sum()} results off, {right.sum()} right"
    return Table(f"{name}: discrimination, {counts}", columns, tuple(rows))


def _passed(off: Array, right: Array, share: float) -> float:
    """The share of right scores below the limit under which no more than a share of the off are."""
    allowed = int(share * len(off))
    return float(np.mean(right < np.sort(off)[allowed]))
