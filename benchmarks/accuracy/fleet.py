"""What a fleet's model finds, on simulated fleets whose deviations are known.

    python -m benchmarks.accuracy.fleet [--fleets 10] [--vehicles 500]

Two models of vehicle, six cameras; vehicles scatter by 0.15 degrees and 4 mm per axis. 30 % of the
vehicles are poorly observed: their error bars are 10 times those of the others (0.05 degrees and
1.5 mm per axis). 5 % of the cameras were moved, by 1 degree and 2 cm.
"""

import time
from collections import Counter

import numpy as np

from benchmarks.tables import Table, parser_of, publish
from calibgraph.audit.fleet_model import FleetModel, fit_fleet, observe
from calibgraph.model.geometry import twists_between
from tests.draws.fleets import Fleet, errors_of, simulate_fleet

Sums = dict[str, list[float]]
"""Values over fleets, by kind."""


def main() -> None:
    """Print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--fleets", type=int, default=10)
    parser.add_argument("--vehicles", type=int, default=500)
    options = parser.parse_args()
    sums, counts, begun = Sums(), Counter[str](), time.perf_counter()
    for seed in range(options.fleets):
        truth = simulate_fleet(np.random.default_rng(seed), options.vehicles)
        model = fit_fleet(observe(truth.rows))
        measure(truth, model, sums, counts)
    seconds = (time.perf_counter() - begun) / options.fleets
    tables = [errors_table(sums), detection_table(counts, seconds)]
    publish(tables)


def measure(truth: Fleet, model: FleetModel, sums: Sums, counts: Counter[str]) -> None:
    """Errors of single and of shrunk estimates, and what stands apart."""
    xi = twists_between(truth.T_camera_lidar, model.T_camera_lidar)
    alone = errors_of(model.observations.T_camera_lidar, truth.T_camera_lidar)
    shrunk = errors_of(model.T_camera_lidar, truth.T_camera_lidar)
    nees = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(model.covariance), xi) / 6
    for name, chosen in (("poor", truth.poor), ("good", ~truth.poor)):
        for what, values in (("alone", alone**2), ("shrunk", shrunk**2), ("nees", nees)):
            sums.setdefault(f"{name} {what}", []).extend(values[chosen].tolist())
        hit = model.apart & truth.moved & chosen
        counts.update({f"{name} moved": int((truth.moved & chosen).sum()),
                            f"{name} found": int(hit.sum())})  # fmt: skip
    counts.update({"false": int((model.apart & ~truth.moved).sum()), "cameras": len(truth.moved)})


def errors_table(sums: Sums) -> Table:
    """Root mean squares and NEES."""
    rows = []
    for label, name in (("poorly observed", "poor"), ("others", "good")):
        degrees = [np.degrees(np.sqrt(np.mean(sums[f"{name} {w}"]))) for w in ("alone", "shrunk")]
        nees = np.mean(sums[f"{name} nees"])
        rows.append((label, *(f"{value:.3f}" for value in degrees), f"{nees:.2f}"))
    head = ("vehicles", "alone [deg]", "with the fleet [deg]", "NEES")
    return Table("Rotation error (root mean square) and normalised squared error", head, (*rows,))


def detection_table(counts: Counter[str], seconds: float) -> Table:
    """What was found of what is there."""
    rows = [
        ("moved cameras, others", f"{counts['good found']} of {counts['good moved']}"),
        ("moved cameras, poorly observed", f"{counts['poor found']} of {counts['poor moved']}"),
        ("cameras flagged but not moved", f"{counts['false']} of {counts['cameras']}"),
        ("seconds per fleet", f"{seconds:.1f}"),
    ]  # fmt: skip
    return Table("What is found", ("what", "count"), tuple(rows))


if __name__ == "__main__":
    main()
