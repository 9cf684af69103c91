"""How often ``drift`` finds a moved camera where nothing has moved.

    python -m benchmarks.accuracy.drift [--pool 150] [--calls 500]

Results are solves of simulated tables of a stereo pair, 10 frames each. A call compares results
drawn from the pool. The tolerance is next to nothing, so that whatever is significant is CHANGED.
Three kinds of recordings:

* sharp: matches with errors of their own and of their frames;
* shared: with an error that all frames of a recording share, drawn anew for each, of the size that
  the matcher ``structure`` reports;
* common: with such an error, the same in all recordings, as of a lens.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.uncertainty import ERRORS
from benchmarks.tables import Table, parser_of, publish
from calibgraph import Calibration, drift, simulate_correspondences, solve
from tests.draws.places import displaced, stereo

Array = NDArray[np.float64]
Rng = np.random.Generator

SHARED = np.repeat([np.radians(0.09), 0.02], 3)
"""Sigma per axis of the shared error, half of its variance the cloud's and half each camera's."""
KINDS = ("sharp", "shared", "common")
FRAMES, MATCHES = 10, 100
TOLERANCE = {"tolerance_deg": 1e-6, "tolerance_cm": 1e-6}
COUNTS = (2, 3, 5, 10)


def main() -> None:
    """Fill the pools, count, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--pool", type=int, default=150)
    parser.add_argument("--calls", type=int, default=500)
    options = parser.parse_args()
    pools = {kind: fill_pool(kind, options.pool) for kind in KINDS}
    publish([false_alarms(pools, options.calls)])


def fill_pool(kind: str, size: int) -> list[Calibration]:
    """Results of as many recordings."""
    rng = np.random.default_rng(KINDS.index(kind))
    common = draw_shared(rng)
    return [
        solve_one(kind, common if kind == "common" else draw_shared(rng), seed)
        for seed in range(size)
    ]


def draw_shared(rng: Rng) -> tuple[Array, Array]:
    """(6,) motion of the cloud and (2, 6) of the cameras' matches."""
    half = SHARED / np.sqrt(2)
    return half * rng.standard_normal(6), half * rng.standard_normal((2, 6))


def solve_one(kind: str, shared: tuple[Array, Array], seed: int) -> Calibration:
    """The result of one recording, from the true rig as its guess; the table states its errors."""
    truth = stereo()
    seen = truth if kind == "sharp" else displaced(truth, *shared)
    table = simulate_correspondences(
        seen, frames=FRAMES, matches=MATCHES, errors=ERRORS, depth_m=None, seed=seed
    )
    if kind != "sharp":
        stated = {"systematic_rotation_rad": SHARED[0], "systematic_translation_m": SHARED[3]}
        table = replace(table, metadata={**table.metadata, **stated})
    return replace(solve(truth, table), correspondences=None)


def choose(pool: Sequence[Calibration], count: int, rng: Rng) -> list[Calibration]:
    """Different results of a pool."""
    return [pool[k] for k in rng.choice(len(pool), count, replace=False)]


def false_alarms(pools: dict[str, list[Calibration]], calls: int) -> Table:
    """Per kind and number of results, how often anything CHANGED though nothing moved."""
    rng = np.random.default_rng(10)
    rows = []
    for kind, pool in pools.items():
        cells = []
        for count in COUNTS:
            found = [drift(choose(pool, count, rng), **TOLERANCE) for _ in range(calls)]
            cells.append(f"{np.mean([each.status == 'CHANGED' for each in found]):.1%}")
        rows.append((kind, *cells))
    heads = ("recordings", *(f"{count} results" for count in COUNTS))
    return Table(f"CHANGED though nothing moved, of {calls} calls each (stated: 1 %)", heads,
                 tuple(rows))  # fmt: skip


if __name__ == "__main__":
    main()
