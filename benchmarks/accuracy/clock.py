"""Images that are taken later than their clouds, before and after the clock is estimated.

    python -m benchmarks.accuracy.clock [--draws 30] [--data FOLDER ...]

Simulated tables as in ``benchmarks.accuracy.lens``, of a LiDAR on a car in town: 2 to 15 m/s, turns
of 0.2 rad/s. NEES is the squared error of a camera's pose in the metric of its covariance; its mean
over 6 should be 1. With ``--data``, recordings at 10 Hz in folders whose rig is the reference: each
image goes with its own cloud, or with the one before it, which makes it 100 ms late.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy.lens import Drawn, cells_of, errors_of, nees_of, simulated
from benchmarks.tables import Table, parser_of, publish
from calibgraph import Config, Dataset, calibrate, evaluate, load_dataset, perturb
from calibgraph.solver.joint import solve_joint
from factors import Clock
from tests.draws.clocks import draw_twists, put_clock_error

CASES = (
    ("offset", 0.0, 0.0), ("offset", 0.005, 0.0), ("offset", 0.02, 0.0), ("offset", 0.1, 0.0),
    ("readout", 0.0, 0.03), ("clock", 0.02, 0.03), ("lens,clock", 0.02, 0.03),
)  # fmt: skip
"""What is estimated; offset and read-out [s]."""

COLUMNS = (
    "estimated", "offset ms", "read-out ms", "before [deg]", "[cm]", "after [deg]", "[cm]",
    "NEES / 6", "clock off [ms]", "sigma [ms]", "z^2",
)  # fmt: skip
RECORDED = (
    "recording", "late [ms]", "estimated", "verdict", "error [deg]", "[cm]", "offset [ms]", "sigma"
)  # fmt: skip
INTERVAL_S = 0.1


def draw(part: str, clock: Clock, seed: int) -> Drawn:
    """Solve a table of late images."""
    truth, table = simulated(seed)
    rng = np.random.default_rng([seed, 1])
    late = put_clock_error(table, truth, draw_twists(int(table.frame.max()) + 1, rng), clock)
    before, after = (solve_joint(truth, late, Config(estimate=one)) for one in ((), part))
    errors = errors_of(after, truth)
    right = {"offset": clock.offset_s, "readout": clock.readout_s}
    clocks = [one for of in after.lens.values() for one in of if one.name in right]
    return Drawn(
        errors_of(before, truth),
        errors,
        nees_of(after, errors),
        [1e3 * (one.value - right[one.name]) for one in clocks],
        [1e3 * one.sigma for one in clocks],
    )


def main() -> None:
    """Draw, solve, and print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--data", nargs="*", type=Path, default=[], help="recordings at 10 Hz")
    options = parser.parse_args()
    tables = []
    if options.draws:
        rows = tuple(
            (part, f"{1e3 * offset_s:g}", f"{1e3 * readout_s:g}",
             *cells_of([draw(part, Clock(offset_s, readout_s), s) for s in range(options.draws)]))
            for part, offset_s, readout_s in CASES
        )  # fmt: skip
        tables.append(Table(f"{options.draws} draws, medians of 2 cameras", COLUMNS, rows))
    if options.data:
        recorded = tuple(row for folder in options.data for row in rows_of(folder))
        tables.append(Table("Recordings, the worst camera", RECORDED, recorded))
    publish("accuracy.clock", tables, record=options.record)


def rows_of(folder: Path) -> Iterator[tuple[str, ...]]:
    """A recording with its own images and with those of the next frame, fixed and estimated."""
    data = load_dataset(folder, interval_s=INTERVAL_S)
    guess = perturb(data.rig, rotation_deg=1.0, translation_m=0.1, seed=1)
    for later in (0, 1):
        for estimate in ((), ("offset",)):
            result = calibrate(late_images(data, later), guess, config=Config(estimate=estimate))
            errors = evaluate(result.rig, data.rig).cameras.values()
            found = [one for of in result.lens.values() for one in of]
            worst = max(found, key=lambda one: abs(one.value - later * INTERVAL_S), default=None)
            yield (
                folder.name, f"{1e3 * later * INTERVAL_S:g}", "yes" if estimate else "no",
                result.verdict.status,
                f"{max(one.rotation_error_deg for one in errors):.3f}",
                f"{max(one.translation_error_cm for one in errors):.1f}",
                *(
                    ("-", "-") if worst is None
                    else (f"{1e3 * worst.value:.1f}", f"{1e3 * worst.sigma:.1f}")
                ),
            )  # fmt: skip


def late_images(data: Dataset, later: int) -> Dataset:
    """Each cloud with the images of a later frame."""
    last = len(data.frames) - later
    pairs = zip(data.frames[:last], data.frames[later:], strict=True)
    frames = tuple(replace(one, image_paths=other.image_paths) for one, other in pairs)
    return replace(data, frames=frames)


if __name__ == "__main__":
    main()
