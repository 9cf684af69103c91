"""Fit and judge the probability that a result is off: ``calibgraph.trust.probability``.

    python -m benchmarks.accuracy.verdicts --set tune --tables 24 --data 3 --out out/tune.jsonl
    python -m benchmarks.accuracy.verdicts --set count --tables 24 --data 3 --out out/count.jsonl
    python -m benchmarks.accuracy.probability --tune out/tune.jsonl --count out/count.jsonl

The weights come from the first files, the tables from the others, which share no recordings (but
for the motorway), scenes or seeds with them. ``--write`` writes the weights into the package; a
model of which no case is given keeps its own. Without ``--tune`` the package's weights are judged.

A result counts as off beyond 0.5 deg or 10 cm. Results that are off, and the others, count alike in
the fit; the intercept is then moved, and the tables are weighted, to where one result in ten is
off: as if users made so many mistakes. Weights are the most probable ones under a normal prior
about values that are the same for all checks: one that has seen too little keeps nearly those.
A kind of check that no case had makes a FAIL by itself from its limit of WARN on.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import expit, logit

from benchmarks.accuracy import data_cases, ledger, table_cases
from benchmarks.accuracy.ledger import Record
from benchmarks.accuracy.verdicts import class_of
from benchmarks.tables import ROOT, Table, add_record_option
from calibgraph.model.verdict import FAIL_ABOVE, Check, ErrorProbability, Verdict
from calibgraph.trust.lens_parameter import probability_of_lens
from calibgraph.trust.probability import (
    STRUCTURE,
    TABLES,
    contributions,
    probability_beyond,
    steps,
    worst_severities,
)

Array = np.ndarray

SHARE_OFF = 0.1
TOLERANCE = (0.5, 10.0)
USUAL = np.array([0.3, 6.5, 3.0])
"""Prior means: log odds by a check that goes through PASS, WARN and FAIL."""
SPREAD = np.array([1.0, 3.0, 3.0])
INTERCEPT, INTERCEPT_SPREAD = -6.0, 1.0
VOTE = {"PASS": 0.005, "WARN": 0.1, "FAIL": 0.9}
"""The probabilities that a vote stands for, to compare it with."""
BINS = (0.0, 0.002, 0.005, 0.02, 0.1, 0.2, 0.5, 0.9, 1.0)
FILE = ROOT / "calibgraph" / "trust" / "probability.json"
AMBIGUOUS = ("two_poses_45",)
"""Kinds in which the matches cannot tell which of two extrinsics is right: a FAIL is wanted,
although the result is right. They take no part in the fit nor in how well the probability holds;
verdicts are counted with them."""
UNCOUNTED = (*table_cases.UNDETECTABLE, *data_cases.UNDETECTABLE)


@dataclass(frozen=True, eq=False)
class Sample:
    """One camera of one run.

    Attributes:
        level: "table" or "data".
        kind: of the case.
        severities: per kind of check.
        by_bar: the probability that its error bar alone allows.
        by_lens: that of a wrong lens.
        off: whether it is off.
        right: whether it is right: well within the tolerance.
        vote: the worst status of its checks.
    """

    level: str
    kind: str
    severities: dict[str, float]
    by_bar: float
    by_lens: float
    off: bool
    right: bool
    vote: str

    @property
    def given(self) -> float:
        """The probability by its error bar and its lens."""
        return 1 - (1 - self.by_bar) * (1 - self.by_lens)


def samples_of(records: Iterable[Record]) -> list[Sample]:
    """The results of cases that data can tell from right ones, without those decided anyway."""
    return [
        _sample(record, camera)
        for record in records if record["kind"] not in UNCOUNTED
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
        by_lens=probability_of_lens((kind, status, value) for kind, status, value, *_ in checks),
        off=which == "off",
        right=which == "right",
        vote=_vote(checks),
    )


def _beyond(camera: Record) -> float:
    """By the posterior; by the error bar alone in records that lack it."""
    if camera.get("beyond") is not None:
        return float(camera["beyond"])
    rows = camera["covariance"]
    return probability_beyond(None if rows is None else np.array(rows), TOLERANCE)


def _vote(checks: Sequence[Sequence[Any]]) -> str:
    return max((status for _, status, *_ in checks), key=[*VOTE].index, default="PASS")


def fit(samples: Sequence[Sample]) -> dict[str, Any]:
    """The most probable intercept and weights."""
    kinds = sorted({kind for sample in samples for kind in sample.severities})
    rows = np.array(
        [[steps(sample.severities.get(kind, 0.0)) for kind in kinds] for sample in samples]
    ).reshape(len(samples), -1)
    off = np.array([sample.off for sample in samples])
    given = np.array([sample.given for sample in samples])
    share = off.mean()
    counts = np.where(off, 0.5 / share, 0.5 / (1 - share))
    mean, spread = np.tile(USUAL, len(kinds)), np.tile(SPREAD, len(kinds))

    def loss(values: Array) -> tuple[float, Array]:
        z = values[0] + rows @ values[1:]
        right = 1 / (1 + np.exp(z))  # not grossly wrong
        p = np.clip(1 - right * (1 - given), 1e-12, 1 - 1e-12)
        likelihood = counts * np.where(off, np.log(p), np.log(1 - p))
        slope = counts * np.where(off, (1 - p) * (1 - right) / p, right - 1)
        away = np.append((values[0] - INTERCEPT) / INTERCEPT_SPREAD, (values[1:] - mean) / spread)
        gradient = -np.append(slope.sum(), slope @ rows)
        gradient += away / np.append(INTERCEPT_SPREAD, spread)
        return float(-likelihood.sum() + (away**2).sum() / 2), gradient

    start = np.append(INTERCEPT, mean)
    bounds = [(None, None), *[(0.0, None)] * len(mean)]
    found = minimize(loss, start, jac=True, bounds=bounds, method="L-BFGS-B",
                     options={"maxiter": 5000, "maxfun": 20000}).x  # fmt: skip
    weights = found[1:].reshape(-1, 3).round(3)
    intercept = round(float(found[0] + logit(SHARE_OFF)), 3)
    first, _, last = USUAL.tolist()
    to_fail = round(float(logit(FAIL_ABOVE)) - intercept - first, 3)  # at the limit of WARN
    return {
        "intercept": intercept,
        "weights": {kind: weights[i].tolist() for i, kind in enumerate(kinds)},
        "other": [first, to_fail, last],
    }


def with_intercept(model: dict[str, Any], samples: Sequence[Sample]) -> dict[str, Any]:
    """The same weights with the intercept that suits the samples best."""
    off = np.array([sample.off for sample in samples])
    counts = np.where(off, SHARE_OFF / off.mean(), (1 - SHARE_OFF) / (1 - off.mean()))

    def loss(intercept: float) -> float:
        p = np.clip(probabilities({**model, "intercept": intercept}, samples), 1e-12, 1 - 1e-12)
        return -float(counts @ np.log(np.where(off, p, 1 - p)))

    found = minimize_scalar(loss, bounds=(-15.0, 0.0), method="bounded").x
    return {**model, "intercept": round(float(found), 3)}


def drop(sample: Sample, kinds: Collection[str]) -> Sample:
    """The sample without some kinds of checks."""
    kept = {kind: value for kind, value in sample.severities.items() if kind not in kinds}
    return replace(sample, severities=kept)


def doubts(model: dict[str, Any], samples: Sequence[Sample]) -> list[ErrorProbability]:
    """Of every sample."""
    weights, other = model["weights"], model["other"]
    grossly = [
        expit(model["intercept"] + sum(contributions(s.severities, weights, other).values()))
        for s in samples
    ]
    return [
        ErrorProbability(1 - (1 - p) * (1 - s.by_lens), s.by_bar)
        for p, s in zip(grossly, samples, strict=True)
    ]


def probabilities(model: dict[str, Any], samples: Sequence[Sample]) -> Array:
    """(n,) of every sample."""
    return np.array([doubt.probability for doubt in doubts(model, samples)])


def status_of(sample: Sample, doubt: ErrorProbability) -> str:
    """The verdict, by the probability that it is off."""
    checks = (Check("worst", sample.vote, ""),)  # type: ignore[arg-type]
    return Verdict(checks, doubt).status


def judged(name: str, model: dict[str, Any], samples: Sequence[Sample]) -> list[Table]:
    """Verdicts beside those of a vote, and how well the probability holds."""
    clear = [sample for sample in samples if sample.kind not in AMBIGUOUS]
    return [
        cuts(name, model, samples),
        *reliability(f"{name}, without {', '.join(AMBIGUOUS)}", model, clear),
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
    count = np.where(off, SHARE_OFF / off.mean(), (1 - SHARE_OFF) / (1 - off.mean()))
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


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tune", type=Path, nargs="+", default=[], help="files of verdicts")
    parser.add_argument("--count", type=Path, nargs="+", required=True, help="files of verdicts")
    parser.add_argument("--without", default="", help="kinds of checks, left out of everything")
    parser.add_argument("--keep-weights", action="store_true", help="fit the intercepts alone")
    parser.add_argument("--write", action="store_true", help="the weights into the package")
    add_record_option(parser)
    options = parser.parse_args()
    sets = {
        name: [record for path in paths for record in ledger.read(path)]
        for name, paths in (("fitted", options.tune), ("kept out", options.count))
    }
    models, tables, records = {}, [], [record for each in sets.values() for record in each]
    for name, level in ((TABLES, "table"), (STRUCTURE, "data")):
        of_level = {
            which: [
                drop(sample, options.without.split(","))
                for sample in samples_of(r for r in each if r["level"] == level)
            ]
            for which, each in sets.items()
        }
        clear = [sample for sample in of_level["fitted"] if sample.kind not in AMBIGUOUS]
        present = json.loads(FILE.read_text("utf-8"))["models"][name]
        if not clear:
            models[name] = present
        else:
            models[name] = with_intercept(present, clear) if options.keep_weights else fit(clear)
        for which, samples in of_level.items():
            if samples:
                tables += judged(f"{name}, {which}", models[name], samples)
    ledger.publish_cases("accuracy.probability", tables, records, record=options.record)
    if options.write:
        text = {"format": "calibgraph-probability/1", "fitted_by": ledger.code(),
                "results": {n: len(samples_of(each)) for n, each in sets.items()},
                "models": models}  # fmt: skip
        FILE.write_text(json.dumps(text, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
