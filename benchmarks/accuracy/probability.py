"""Fit and judge the probability that a result is off: ``calibgraph.trust.probability``.

    python -m benchmarks.accuracy.verdicts --set tune --tables 24 --data 3 --out out/tune.jsonl
    python -m benchmarks.accuracy.verdicts --set count --tables 24 --data 3 --out out/count.jsonl
    python -m benchmarks.accuracy.probability --tune out/tune.jsonl --count out/count.jsonl

The weights come from the first files, the tables from the others, which share no recordings (but
for the motorway), scenes or seeds with them. ``--write`` writes the weights into the package; a
model without cases keeps its own. Without ``--tune`` the package's weights are judged,
or those of another version: ``--weights probability.json``.

A result counts as off beyond 0.5 deg or 10 cm. Results that are off, and the others, count alike in
the fit; the intercept is then moved, and the tables are weighted, to where one result in ten is
off: as if users made so many mistakes. Weights are the most probable ones under a normal prior
about values that are the same for all checks: one that has seen too little keeps nearly those.
A kind of check that no case had makes a FAIL by itself from its limit of WARN on.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.special import logit

from benchmarks.accuracy import ledger
from benchmarks.accuracy.probability_tables import judged
from benchmarks.accuracy.verdict_samples import (
    AMBIGUOUS,
    SHARE_OFF,
    Sample,
    drop,
    probabilities,
    samples_of,
)
from benchmarks.tables import ROOT, add_record_option
from calibgraph.model.verdict import FAIL_ABOVE
from calibgraph.trust.probability import STRUCTURE, TABLES, steps

Array = np.ndarray

USUAL = np.array([0.3, 6.5, 3.0])
"""Prior means: log odds by a check that goes through PASS, WARN and FAIL."""
SPREAD = np.array([1.0, 3.0, 3.0])
INTERCEPT, INTERCEPT_SPREAD = -6.0, 1.0
FILE = ROOT / "calibgraph" / "trust" / "probability.json"


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


def main() -> None:
    """Fit, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tune", type=Path, nargs="+", default=[], help="files of verdicts")
    parser.add_argument("--count", type=Path, nargs="+", required=True, help="files of verdicts")
    parser.add_argument("--weights", type=Path, default=FILE, help="judged without --tune")
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
        present = json.loads(options.weights.read_text("utf-8"))["models"][name]
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
