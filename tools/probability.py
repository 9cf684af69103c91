"""Fit and judge the probability that a result is off: ``calibgraph.trust.probability``.

    python -m benchmarks.accuracy.verdicts --set tune --tables 24 --data 3 --out out/tune.jsonl
    python -m benchmarks.accuracy.verdicts --set count --tables 24 --data 3 --out out/count.jsonl
    python -m tools.probability --tune out/tune.jsonl --count out/count.jsonl

The weights come from the first files, the tables from the others, which share no recordings (but
for the motorway), scenes or seeds with them. ``--write`` writes the weights into the package; a
model without cases keeps its own. Without ``--tune`` the package's weights are judged,
or those of another version: ``--weights probability.json``.

A result counts as off beyond 0.5 deg or 10 cm. Fit and tables are weighted as if one result in ten
were off, the share assumed for users. Weights are the most probable ones under a normal prior
about values that are the same for all checks: one that has seen too little keeps nearly those.
A kind of check that no case had makes a FAIL by itself from its limit of WARN on.
"""

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from benchmarks.accuracy import ledger
from benchmarks.accuracy.cases import UNDETECTABLE
from benchmarks.accuracy.ledger import Record
from benchmarks.accuracy.verdicts import STATUSES, class_of
from benchmarks.tables import ROOT, Table, parser_of
from calibgraph.model.verdict import FAIL_ABOVE, TOLERANCE, Check, ErrorProbability, Verdict
from calibgraph.trust.probability import (
    STRUCTURE,
    TABLES,
    WORST,
    contributions,
    probability_beyond,
    probability_by_values,
    steps,
    worst_severities,
)

Array = np.ndarray

SHARE_OFF = 0.1
AMBIGUOUS = ("two_poses_45",)
"""Kinds in which the matches cannot tell which of two extrinsics is right: a FAIL is wanted,
although the result is right. They take no part in the fit nor in how well the probability holds;
verdicts are counted with them."""
USUAL = np.array([0.3, 6.5, 3.0])
"""Prior means: log odds by a check that goes through PASS, WARN and FAIL."""
SPREAD = np.array([1.0, 3.0, 3.0])
OF_WORST = (WORST, "swapped_cameras")
"""The inputs of the model of runs. 127 results are too few for a weight of each of 40 kinds of
checks, and the worst alone foretells a left-out recording better. A swap is a likelihood ratio."""
LAST_OF_WORST = 1.0  # its spread: where it is 0, a FAIL would be no more probable than its limit
HOLDS, HOLDS_SPREAD = np.array([2.0, 0.0]), np.array([0.5, 1.0])
"""How far values and error bars hold: log odds that a value does, logarithm of the factor of a
bar's odds. Values count how seldom lenses are wrong, and one that is taken for right is a PASS."""
INTERCEPT, INTERCEPT_SPREAD = -8.2, 1.0
FILE = ROOT / "calibgraph" / "trust" / "probability.json"


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


def fit(samples: Sequence[Sample], level: str = TABLES) -> dict[str, Any]:
    """The most probable intercept and weights.

    Of tables every kind of check has weights. Of runs the worst check has, and how far error bars
    and the checks whose value is a probability are to be relied on. A check that is at its limit of
    FAIL is one by itself, for runs, and for tables if no case had its kind.
    """
    seen = sorted({kind for sample in samples for kind in sample.severities} - {WORST})
    of_worst = level == STRUCTURE
    kinds = OF_WORST if of_worst else seen
    spread = np.tile(SPREAD, len(kinds))
    spread[2] = LAST_OF_WORST if of_worst else SPREAD[2]
    found = _most_probable(samples, kinds, spread, of_worst=of_worst)
    intercept, weights = round(float(found[0]), 3), found[1:-2].reshape(-1, 3).round(3)
    first, _, last = USUAL.tolist()
    to_fail = round(float(logit(FAIL_ABOVE)) - intercept - first, 3)  # at the limit of WARN
    return {
        "intercept": intercept,
        "weights": {WORST: [0.0] * 3} | {kind: weights[i].tolist() for i, kind in enumerate(kinds)},
        "other": [0.0] * 3 if of_worst else [first, to_fail, last],
        "seen": seen,
        "value_reliability": round(float(expit(found[-2])), 3) if of_worst else 1.0,
        "bar_odds": round(float(np.exp(found[-1])), 3) if of_worst else 1.0,
    }


def _most_probable(
    samples: Sequence[Sample], kinds: Sequence[str], spread: Array, *, of_worst: bool
) -> Array:
    """Intercept, weights of the kinds, how far values and error bars hold."""
    rows = np.array(
        [steps(np.array([s.severities.get(kind, 0.0) for kind in kinds])) for s in samples]
    ).reshape(len(samples), -1)
    off, by_bar, by_values = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("off", "by_bar", "by_values")
    )
    counts = shares(samples)
    usual = np.concatenate([[INTERCEPT], np.tile(USUAL, len(kinds)), HOLDS])
    spreads = np.concatenate([[INTERCEPT_SPREAD], spread, HOLDS_SPREAD])

    def complete(values: Array) -> Array:
        """With the weight that the limit of FAIL gives; tables rely on values and bars."""
        values = values.copy()
        if of_worst:
            values[2] = max(float(logit(FAIL_ABOVE)) - values[0] - values[1], 0.0)
        else:
            values[-2:] = np.inf, 0.0
        return values

    def loss(values: Array) -> float:
        z = complete(values)
        odds = np.exp(z[-1]) * by_bar
        right = expit(-(z[0] + rows @ z[1:-2]))  # not grossly wrong
        within = (1 - by_bar) / (1 - by_bar + odds)
        p = 1 - right * (1 - expit(z[-2]) * by_values) * within
        likelihood = counts * np.log(np.clip(np.where(off, p, 1 - p), 1e-12, 1.0))
        return float(-likelihood.sum() + (((values - usual) / spreads) ** 2).sum() / 2)

    bounds = [(None, None), *[(0.0, None)] * (3 * len(kinds)), *[(None, None)] * 2]
    found = minimize(loss, usual, bounds=bounds, method="L-BFGS-B",
                     options={"maxiter": 5000, "maxfun": 200_000}).x  # fmt: skip
    return complete(found)


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


def main() -> None:
    """Fit, print, write."""
    parser = parser_of(__doc__)
    parser.add_argument("--tune", type=Path, nargs="+", default=[], help="files of verdicts")
    parser.add_argument("--count", type=Path, nargs="+", required=True, help="files of verdicts")
    parser.add_argument("--weights", type=Path, default=FILE, help="judged without --tune")
    parser.add_argument("--write", action="store_true", help="the weights into the package")
    options = parser.parse_args()
    sets = {
        name: [record for path in paths for record in ledger.read(path)]
        for name, paths in (("fitted", options.tune), ("kept out", options.count))
    }
    models, tables, records = {}, [], [record for each in sets.values() for record in each]
    for name, level in ((TABLES, "table"), (STRUCTURE, "data")):
        of_level = {
            which: samples_of(r for r in each if r["level"] == level)
            for which, each in sets.items()
        }
        clear = [sample for sample in of_level["fitted"] if sample.kind not in AMBIGUOUS]
        present = json.loads(options.weights.read_text("utf-8"))["models"][name]
        models[name] = fit(clear, name) if clear else present
        for which, samples in of_level.items():
            if samples:
                tables += judged(f"{name}, {which}", models[name], samples)
    ledger.publish_cases(tables, records)
    if options.write:
        text = {"format": "calibgraph-probability/2", "fitted_by": ledger.code(),
                "results": {n: len(samples_of(each)) for n, each in sets.items()},
                "models": models}  # fmt: skip
        FILE.write_text(json.dumps(text, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
