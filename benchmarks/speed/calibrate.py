"""A whole calibration: seconds per stage and peak memory, by cameras, frames and image size.

    python -m benchmarks.speed.calibrate [--cameras 1 2 6 12] [--frames 5 10 30 100]
        [--sizes 640x480 1242x375 1920x1200] [--longest-s 600] [--folder DIR]

Cameras of a ring and a 64-beam LiDAR in a rendered street, from a guess 2 degrees and 0.2 m off.
More than 5 frames repeat these: they are matched like others, but in the solve count as one. Each
case is a process of its own, `speed.stages`: the whole command, with all frames (without `--frames`
it would take 30 of more), up to the written report.

Finished cases are kept in --folder with the streets, so that the table can be run in parts: the
same code does not run a case again. A case is skipped if it would take longer than --longest-s,
extrapolated from a smaller one in proportion to cameras x frames.

Growth: exponents of the power law of each time, and of the memory, in cameras, frames and pixels,
fitted to all cases of the table.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.ledger import code
from benchmarks.speed.stages import STAGES, WORK, Run, run_in_process
from benchmarks.speed.streets import link_dataset, render, street_rig
from benchmarks.tables import Table, add_record_option, publish

Array = NDArray[np.float64]

VERDICTS = ("PASS", "WARN", "FAIL")
LEAST_S = 0.05  # stages that take less have no exponent


@dataclass(frozen=True, order=True)
class Case:
    """The size of a problem."""

    width_px: int
    height_px: int
    cameras: int
    frames: int

    @property
    def variables(self) -> tuple[int, int, int]:
        """Cameras, frames, pixels of an image: what the time may depend on."""
        return self.cameras, self.frames, self.width_px * self.height_px

    @property
    def work(self) -> int:
        """Images: what the time is taken to be proportional to at most."""
        return self.cameras * self.frames

    def cells(self) -> tuple[str, ...]:
        """The first columns of its row."""
        return f"{self.width_px}x{self.height_px}", str(self.cameras), str(self.frames)


Runs = dict[Case, Run]


def main() -> None:
    """Run the cases that are not there yet, and print the tables."""
    options = parse_options()
    cases = [
        Case(width, height, cameras, frames)
        for (width, height), cameras, frames in product(
            options.sizes, options.cameras, options.frames
        )
    ]
    options.folder.mkdir(parents=True, exist_ok=True)
    runs = run_cases(cases, options.folder, options.longest_s)
    publish("speed.calibrate", tables(runs), record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    sizes = [(640, 480), (1242, 375), (1920, 1200)]
    kept = Path(tempfile.gettempdir()) / "calibgraph_speed"
    parser.add_argument("--cameras", type=int, nargs="+", default=[1, 2, 6, 12])
    parser.add_argument("--frames", type=int, nargs="+", default=[5, 10, 30, 100])
    parser.add_argument("--sizes", type=size, nargs="+", default=sizes, metavar="WIDTHxHEIGHT")
    parser.add_argument("--longest-s", type=float, default=600.0)
    parser.add_argument("--folder", type=Path, default=kept, help="streets and finished cases")
    add_record_option(parser)
    return parser.parse_args()


def size(text: str) -> tuple[int, int]:
    """Width and height of an image."""
    width, height = text.split("x")
    return int(width), int(height)


def run_cases(cases: Sequence[Case], folder: Path, longest_s: float) -> Runs:
    """Run cases, small ones first, unless they are in the folder or would take too long."""
    kept, runs = folder / "cases.jsonl", Runs()
    done = read_runs(kept)
    ring = max(case.cameras for case in cases)
    for case in sorted(cases, key=lambda case: (case.work, case)):
        expected_s = expected(runs, case)
        name = ", ".join(case.cells())
        if case in done:
            runs[case] = done[case]
        elif expected_s > longest_s:
            print(f"{name}: not run, would take up to {expected_s:.0f} s", flush=True)
        else:
            runs[case] = run_case(case, folder, ring, warm_up=not done and not runs)
            if runs[case].verdict in VERDICTS:  # else it failed, and may not another time
                line = {"code": code(), "case": asdict(case), "run": asdict(runs[case])}
                with kept.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            print(f"{name}: {', '.join(run_cells(runs[case]))}", flush=True)
    return runs


def read_runs(path: Path) -> Runs:
    """The finished cases that the present code has run."""
    lines = path.read_text("utf-8").splitlines() if path.is_file() else []
    kept = [line for line in map(json.loads, lines) if line["code"] == code()]
    return {Case(**line["case"]): Run(**line["run"]) for line in kept}


def expected(runs: Runs, case: Case) -> float:
    """Seconds that a case takes at most, from the largest finished one that is no larger."""
    smaller = [
        (done.work, run.wall_s)
        for done, run in runs.items()
        if run.wall_s > 0 and done.cameras <= case.cameras and done.frames <= case.frames
    ]
    work, seconds = max(smaller, default=(1, 0.0))
    return seconds * case.work / work


def run_case(case: Case, folder: Path, ring: int, *, warm_up: bool) -> Run:
    """Run a case; the first of all twice, so that it finds the kernels compiled."""
    rig = street_rig(ring, case.width_px, case.height_px)
    rendered = render(folder, rig)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        dataset = Path(temporary) / "dataset"
        link_dataset(rendered, dataset, case.cameras, case.frames)
        if warm_up:
            run_in_process(dataset)
        return run_in_process(dataset)


SIZE_COLUMNS = ("image", "cameras", "frames")
RUN_COLUMNS = ("wall [s]", "CPU [s]", "cores busy", "peak [MB]", "verdict")


def run_cells(run: Run) -> tuple[str, ...]:
    """Totals of a run."""
    numbers = f"{run.wall_s:.1f}", f"{run.cpu_s:.1f}", f"{run.cpu_s / run.wall_s:.2f}"
    return *numbers, f"{run.peak_mb:.0f}", run.verdict


def tables(runs: Runs) -> list[Table]:
    """All tables: totals, stages, growth."""
    ordered = sorted(runs.items())
    totals = tuple((*case.cells(), *run_cells(run)) for case, run in ordered)
    found = [Table("Whole calibrations", (*SIZE_COLUMNS, *RUN_COLUMNS), totals)]
    for title, name in (("Processor", "stages_cpu_s"), ("Wall", "stages_wall_s")):
        rows = tuple((*case.cells(), *stage_cells(getattr(run, name))) for case, run in ordered)
        found.append(Table(f"{title} seconds by stage", (*SIZE_COLUMNS, *STAGES), rows))
    return [*found, growth_table({case: run for case, run in ordered if run.stages_cpu_s})]


def stage_cells(seconds: dict[str, float]) -> tuple[str, ...]:
    """Seconds of each stage."""
    return tuple(f"{seconds.get(stage, np.nan):.2f}" for stage in STAGES)


def growth_table(runs: Runs) -> Table:
    """Exponents of each time, and of the memory."""
    measured = {
        "wall": [run.wall_s for run in runs.values()],
        "CPU": [run.cpu_s for run in runs.values()],
        "peak memory": [run.peak_mb for run in runs.values()],
    } | {f"CPU, {stage}": [run.stages_cpu_s[stage] for run in runs.values()] for stage in WORK}
    variables = np.array([case.variables for case in runs], np.float64).reshape(-1, 3)
    rows = []
    for name, values in measured.items():
        cells = ["" if np.isnan(e) else f"{e:.2f}" for e in exponents(variables, np.array(values))]
        rows.append((name, *cells))
    return Table("Growth: exponents", ("", "of cameras", "of frames", "of pixels"), tuple(rows))


def exponents(variables: Array, values: Array) -> Array:
    """Least-squares exponents of a power law.

    Args:
        variables: (n, k).
        values: (n,); those below ``LEAST_S`` are left out.

    Returns:
        (k,) NaN for a variable that does not vary, and for all if there are too few values.
    """
    found = np.full(variables.shape[1], np.nan)
    used = values > LEAST_S
    logs = np.log(variables[used])
    varied = np.ptp(logs, axis=0) > 0 if used.any() else np.zeros(len(found), np.bool_)
    columns = np.column_stack([logs[:, varied], np.ones(used.sum())])
    if varied.any() and np.linalg.matrix_rank(columns) == columns.shape[1]:
        found[varied] = np.linalg.lstsq(columns, np.log(values[used]), rcond=None)[0][:-1]
    return found


if __name__ == "__main__":
    main()
