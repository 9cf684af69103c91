"""The paper's experiment over many draws: tables in Markdown and JSON, and a plot.

    python -m benchmarks.paper kitti --frames 10 100 --draws 50 --out bench

Every draw has new frames and a new guess, 20 degrees and 1.5 m from the truth. Rows: per-camera PnP
and its aggregates, the paper's solver with its settings, each camera alone, ours, ours with a known
relative pose, and ours with weights computed from the simulation's truth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.paper.experiment import Report, run_experiment
from benchmarks.paper.output import worst_cameras, write_report
from benchmarks.paper.sources import Displacement, source_from
from benchmarks.tables import add_record_option, publish
from calibgraph.errors import CalibrationError
from calibgraph.model.config import preset


def main() -> None:
    """Run the experiment, write its files and print the worst cameras."""
    parser = _parser()
    options = parser.parse_args()
    try:
        report = run(options)
        written = write_report(report, options.out)
    except (CalibrationError, ValueError) as error:
        parser.error(str(error))
    tables = [worst_cameras(block) for block in report.blocks]
    publish("paper", tables, record=options.record)
    for path in written:
        print(f"{path}: written")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("data", metavar="DATA", help="a simulated scenario: kitti, walkley, surround, fisheye; a "
        "dataset folder with a reference.yaml; or kitti:DIR,DIR, KITTI odometry sequences of one "
        "rig; recordings are matched again in every draw")  # fmt: skip
    add("--out", type=Path, required=True, help="folder for paper.md, .json and .png")
    add("--frames", type=int, nargs="+", default=[10, 100], help="at most as many as there are")
    add("--draws", type=int, help="of each number of frames (default: 50; of recordings 3)")
    add("--preset", choices=["kitti", "walkley"],
        help="the paper's settings, for its rows (default: those of the data)")  # fmt: skip
    add("--no-trf", action="store_true", help="without the paper's own solver, the slowest")
    add("--rotation-deg", type=float, default=20.0, help="rotation error of every guess")
    add("--translation-m", type=float, default=1.5, help="translation error of every guess")
    add("--jobs", type=int, default=1, help="processes")
    add("--seed", type=int, default=0, help="of everything random")
    add_record_option(parser)
    return parser


def run(options: argparse.Namespace) -> Report:
    """The experiment with these options.

    Raises:
        ValueError, CalibrationError: if an option or the data are wrong, or nothing is found.
    """
    source = source_from(options.data, Displacement(options.rotation_deg, options.translation_m))
    report = run_experiment(
        source,
        frames=options.frames,
        draws=source.default_draws if options.draws is None else options.draws,
        config=preset(options.preset or source.preset).changed(seed=options.seed),
        seed=options.seed,
        jobs=options.jobs,
        trf=not options.no_trf,
        progress=_print_progress,
    )
    if report.is_empty:
        raise CalibrationError(
            f"{options.data}: no method found extrinsics in any draw; calibgraph calibrate "
            "reports why"
        )
    return report


def _print_progress(task: str, done: int, total: int) -> None:
    print(f"{task}: {done} of {total}", file=sys.stderr)


if __name__ == "__main__":
    main()
