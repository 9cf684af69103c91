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

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from benchmarks.accuracy import ledger
from benchmarks.tables import ROOT, parser_of
from calibgraph.model.verdict import FAIL_ABOVE
from calibgraph.trust.probability import STRUCTURE, TABLES, WORST, steps
from tools.verdict_samples import AMBIGUOUS, SHARE_OFF, Sample, judged, samples_of

Array = np.ndarray

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
        [[steps(sample.severities.get(kind, 0.0)) for kind in kinds] for sample in samples]
    ).reshape(len(samples), -1)
    off, by_bar, by_values = (
        np.array([getattr(sample, name) for sample in samples])
        for name in ("off", "by_bar", "by_values")
    )
    counts = np.where(off, SHARE_OFF / off.mean(), (1 - SHARE_OFF) / (1 - off.mean()))
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
