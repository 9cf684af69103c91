"""The paper's experiment over many draws, as tables in Markdown.

    python -m benchmarks.paper kitti --frames 10 100 --draws 50 > paper.md

Every draw has new frames and a new guess, 20 degrees and 1.5 m from the truth. Rows: per-camera PnP
and its aggregates, the paper's solver with its settings, each camera alone, ours, and ours with a
known relative pose.
"""

from benchmarks.paper.draws import source_from
from benchmarks.paper.experiment import run_experiment
from benchmarks.paper.output import markdown
from benchmarks.tables import parser_of, publish
from calibgraph.errors import CalibrationError
from calibgraph.model.config import preset


def main() -> None:
    """Run the experiment and print its tables."""
    parser = parser_of(__doc__)
    parser.prog = "python -m benchmarks.paper"
    add = parser.add_argument
    add("data", metavar="DATA", help="a simulated scenario: kitti, walkley; a "
        "dataset folder with a reference.yaml; or kitti:DIR,DIR, KITTI odometry sequences of one "
        "rig; recordings are matched again in every draw")  # fmt: skip
    add("--frames", type=int, nargs="+", default=[10, 100], help="at most as many as there are")
    add("--draws", type=int, help="of each number of frames (default: 50; of recordings 3)")
    add("--no-trf", action="store_true", help="without the paper's own solver, the slowest")
    add("--jobs", type=int, default=1, help="processes")
    add("--seed", type=int, default=0, help="of everything random")
    options = parser.parse_args()
    try:
        source = source_from(options.data)
        draws = options.draws or (3 if source.folders else 50)
        config = preset(source.preset).changed(seed=options.seed)
        report = run_experiment(
            source, frames=options.frames, draws=draws, config=config, seed=options.seed,
            jobs=options.jobs, trf=not options.no_trf,
        )  # fmt: skip
        if all(row.failed == draws for rows in report.values() for row in rows.values()):
            raise ValueError(f"{options.data}: no method found extrinsics in any draw")
    except (CalibrationError, ValueError) as error:
        parser.error(str(error))
    publish([])
    print(f"\n# {source.name}\n\nSettings of the paper's rows: preset {config.preset}.")
    for part in markdown(source.published_as, draws, report):
        print(f"\n{part}")


if __name__ == "__main__":
    main()
