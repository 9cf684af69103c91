"""What each kind of check adds to the probability that a result is off.

    python -m benchmarks.accuracy.additions --tune out/tune.jsonl --count out/count.jsonl

The weights of ``benchmarks.accuracy.probability`` are fitted to the first files without one kind of
check, kind by kind. A row is by how much the likelihood of the others, kept out, is then lower.
Checks that no kept-out case has, since they were deleted, take no part.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.probability import fit
from benchmarks.accuracy.verdict_samples import (
    AMBIGUOUS,
    Sample,
    drop,
    probabilities,
    samples_of,
    shares,
)
from benchmarks.tables import Table, add_record_option
from calibgraph.trust.probability import STRUCTURE, TABLES, WORST


def main() -> None:
    """Fit without each kind of check, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tune", type=Path, nargs="+", required=True, help="files of verdicts")
    parser.add_argument("--count", type=Path, nargs="+", required=True, help="files of verdicts")
    parser.add_argument("--jobs", type=int, default=2)
    add_record_option(parser)
    options = parser.parse_args()
    records = [[one for path in paths for one in ledger.read(path)]
               for paths in (options.tune, options.count)]  # fmt: skip
    tables = []
    for name, level in ((TABLES, "table"), (STRUCTURE, "data")):
        tuned, kept_out = (
            [s for s in samples_of(r for r in of if r["level"] == level) if s.kind not in AMBIGUOUS]
            for of in records
        )
        if tuned and kept_out:
            tables.append(additions(name, tuned, kept_out, jobs=options.jobs))
    ledger.publish_cases("accuracy.additions", tables, sum(records, []), record=options.record)


def additions(
    name: str, tuned: Sequence[Sample], kept_out: Sequence[Sample], *, jobs: int
) -> Table:
    """Per kind of check, what the kept-out likelihood loses where it is left out of the fit."""
    fitted, kinds = ({k for s in of for k in s.severities} - {WORST} for of in (tuned, kept_out))
    tuned = [drop(sample, fitted - kinds) for sample in tuned]
    kinds &= fitted
    whole = log_likelihood(fit(tuned, name), kept_out)
    with ProcessPoolExecutor(jobs) as pool:
        lost = [*pool.map(partial(_without, name, tuned, kept_out), sorted(kinds))]
    rows = sorted(((whole - found, kind) for found, kind in zip(lost, sorted(kinds), strict=True)))
    return Table(
        f"{name}, kept out: log likelihood {whole:.4f} a result, and what a kind of check adds",
        ("kind of check", "adds, 1e-4"), tuple((kind, f"{1e4 * gain:.1f}") for gain, kind in rows),
    )  # fmt: skip


def _without(name: str, tuned: Sequence[Sample], kept_out: Sequence[Sample], kind: str) -> float:
    left = [[drop(sample, {kind}) for sample in samples] for samples in (tuned, kept_out)]
    return log_likelihood(fit(left[0], name), left[1])


def log_likelihood(model: dict[str, Any], samples: Sequence[Sample]) -> float:
    """Mean of the logarithm of what was foretold, with one result in ten off."""
    p, off = probabilities(model, samples), np.array([sample.off for sample in samples])
    p = np.clip(np.where(off, p, 1 - p), 1e-6, 1.0)
    return float(np.average(np.log(p), weights=shares(samples)))


if __name__ == "__main__":
    main()
