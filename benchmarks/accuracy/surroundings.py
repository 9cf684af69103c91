"""Calibration where there are few walls, corners and poles: rendered, with a LiDAR that errs.

    python -m benchmarks.accuracy.surroundings --starts 8 --frames 5

Per surroundings (``calibgraph simulate street --surroundings``) and seed, a stereo pair or two wide
cameras and a LiDAR of 64 beams with errors of size 1, from 2 degrees and 0.2 m off. A result is off
beyond 0.5 deg or 10 cm of its alignment. Even seeds are to choose by, odd ones are kept out.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.accuracy import ledger
from benchmarks.accuracy.alignment import aligned_rig
from benchmarks.accuracy.error_bars import OFF, pair, wide
from benchmarks.accuracy.ledger import Key, Record
from benchmarks.tables import ROOT, Table, add_record_option
from calibgraph import calibrate, load_dataset, perturb, simulate_street
from calibgraph.simulation.scan_errors import draw_scan_errors
from calibgraph.simulation.surroundings import SURROUNDINGS

BEAMS, STEP_M = 64, 4.0
GUESS_DEG, GUESS_M = 2.0, 0.2
RIGS = {"pair": pair, "wide": wide}


def main() -> None:
    """Render, calibrate, print a row per surroundings."""
    arguments = parse_options()
    cases = [
        Key(where, tuple(RIGS)[seed // 2 % len(RIGS)], str(arguments.frames), seed)
        for seed in range(arguments.starts)
        for where in arguments.surroundings
    ]
    work = partial(run_case, scenes=arguments.scenes)
    records = ledger.records_of(arguments, cases, work)
    tables = [report(records, kept_out=kept_out) for kept_out in (False, True)]
    ledger.publish_cases("accuracy.surroundings", tables, records, record=arguments.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, default=ROOT / "out" / "surroundings")
    parser.add_argument(
        "--surroundings", type=lambda text: text.split(","), default=list(SURROUNDINGS)
    )
    parser.add_argument("--frames", type=int, default=5)
    parser.add_argument("--starts", type=int, default=8, help="seeds")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "surroundings.jsonl")
    parser.add_argument("--summary", type=Path, help="print the tables of a file, run no scene")
    add_record_option(parser)
    return parser.parse_args()


def run_case(case: Key, scenes: Path) -> Record:
    """Render one drive, calibrate from near the truth."""
    folder, truth = scenes / f"{case.level}_{case.data}_{case.seed}", RIGS[case.kind]()
    errors = draw_scan_errors(BEAMS, 1.0, np.random.default_rng([17, case.seed]))
    if not (folder / "rig.yaml").exists():
        shutil.rmtree(folder, ignore_errors=True)
        simulate_street(
            folder, truth, beams=BEAMS, frames=int(case.data), step_m=STEP_M, seed=case.seed,
            sensor_errors=errors, vary_layout=True, surroundings=case.level,
        )  # fmt: skip
    aligned = aligned_rig(truth, truth, folder, BEAMS, errors)
    guess = perturb(truth, rotation_deg=GUESS_DEG, translation_m=GUESS_M, seed=case.seed)
    return ledger.to_record(calibrate(load_dataset(folder, guess), guess), aligned)


COLUMNS = (
    "surroundings", "cameras", "refused", "error, median [deg]", "largest", "median [cm]",
    "largest", "error bar, median [deg]", "[cm]", "median NEES / 6", "off", "PASS", "WARN",
    "right: PASS", "WARN", "FAIL",
)  # fmt: skip


def report(records: Sequence[Record], *, kept_out: bool) -> Table:
    """A row per surroundings."""
    chosen = [record for record in records if record["seed"] % 2 == kept_out]
    rows = [
        (where, *_cells([record for record in chosen if record["level"] == where]))
        for where in dict.fromkeys(record["level"] for record in chosen)
    ]
    return Table("Odd seeds, kept out" if kept_out else "Even seeds", COLUMNS, tuple(rows))


def _cells(records: Sequence[Record]) -> tuple[str, ...]:
    cameras = [camera for record in records for camera in record.get("cameras", {}).values()]
    refused = str(sum("refusal" in record for record in records))
    if not cameras:
        return "0", refused, *[""] * (len(COLUMNS) - 3)
    deg, cm = (np.array([camera[f"error_{unit}"] for camera in cameras]) for unit in ("deg", "cm"))
    bars = [c for c in cameras if c["sigma_deg"] is not None]
    bar_deg, bar_cm = (
        np.median([np.sqrt(np.mean(np.square(c[f"sigma_{u}"]))) for c in bars])
        for u in ("deg", "cm")
    )
    nees = np.median([c["normalised_squared"] for c in bars])
    off = (deg > OFF[0]) | (cm > OFF[1])
    status = np.array([camera["status"] for camera in cameras])
    counts = [int(np.sum(status[which] == verdict)) for which, verdict in (
        (off, "PASS"), (off, "WARN"), (~off, "PASS"), (~off, "WARN"), (~off, "FAIL"))]  # fmt: skip
    return (
        str(len(cameras)), refused, f"{np.median(deg):.3f}", f"{deg.max():.2f}",
        f"{np.median(cm):.2f}", f"{cm.max():.1f}", f"{bar_deg:.3f}", f"{bar_cm:.2f}",
        f"{nees:.2f}", str(int(off.sum())), *map(str, counts),
    )  # fmt: skip


if __name__ == "__main__":
    main()
