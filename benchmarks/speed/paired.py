"""Two versions of the code on the same calibrations, in turn: times, errors, verdicts, differences.

    git worktree add ../before COMMIT
    python -m benchmarks.speed.paired ../before . [--data kitti_odometry] [--cases sample ...]
        [--repeats 3] [--cores 1 2]

Each run is the command `calibgraph calibrate` of one source tree in a process of its own, on the
sample and, if --data is given, on KITTI odometry 00 and 05-08 from guesses within 20 deg and 1.5 m,
and 2 deg and 0.2 m, per axis. The trees take turns, so that other load meets both; times are the
shortest of the repeats, of the whole process. A tree's first run, uncounted, compiles its kernels;
each has a cache of its own in --folder (take a new one for a tree that has changed). With several
--cores, runs are bound to so many cores, and the results must be equal.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from benchmarks.tables import Table, commit, parser_of, publish
from calibgraph import Calibration, evaluate, load_calibration, load_rig, perturb

SEQUENCES = {"00": ("00",), "05-08": ("05", "06", "07", "08")}
GUESSES = {"20deg": (20.0, 1.5, 5), "2deg": (2.0, 0.2, 0)}
"""Degrees and metres per axis, and the seed."""
WARM_UP_FRAMES = "0:2"
TIME_COLUMNS = ("case", "cores", "wall before [s]", "after", "ratio", "CPU before [s]", "after",
                "ratio")  # fmt: skip
ERROR_COLUMNS = ("case", "camera", "before [deg]", "after", "before [cm]", "after",
                 "difference [deg]", "[cm]", "verdict before", "after")  # fmt: skip
CORE_COLUMNS = ("case", "tree", "cores", "wall [s]", "speed-up", "difference [deg]", "[cm]")


@dataclass(frozen=True)
class Case:
    """What is calibrated: folders of the dataset, from a guess; with the rig of the reference."""

    name: str
    folders: tuple[Path, ...]
    guess: Path
    reference: Path


@dataclass(frozen=True, eq=False)
class Measured:
    """A case by a tree on some cores: the shortest times of the repeats, the last result."""

    wall_s: float
    cpu_s: float
    result: Calibration


Setting = tuple[Path, int]
"""A source tree, on so many cores."""
Runs = dict[tuple[str, Setting], Measured]


def main() -> None:
    """Run all cases in all settings, and compare."""
    parser = parser_of(__doc__)
    kept = Path(tempfile.gettempdir()) / "calibgraph_paired"
    parser.add_argument("before", type=Path, help="source tree")
    parser.add_argument("after", type=Path, help="source tree; the sample is this one's")
    parser.add_argument("--data", type=Path, help="KITTI odometry, the folder of sequences/")
    parser.add_argument("--cases", nargs="+", help="by name: sample, '00 20deg', '05-08 2deg'")
    parser.add_argument("--frames", metavar="A:B:STEP", help="of each case (default: all)")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cores", type=int, nargs="+", default=[os.cpu_count() or 1])
    parser.add_argument("--folder", type=Path, default=kept, help="guesses, results, caches")
    options = parser.parse_args()
    trees = [options.before.resolve(), options.after.resolve()]
    options.folder.mkdir(parents=True, exist_ok=True)
    cases = [case for case in all_cases(options.data, trees[1], options.folder)
             if not options.cases or case.name in options.cases]  # fmt: skip
    for tree in dict.fromkeys(trees):
        print(f"{tree.name}: compiling", flush=True)
        degrees, metres, seed = GUESSES["20deg"]  # compiles the kernels of the search, too
        far, reference = options.folder / "far.yaml", cases[0].reference
        perturb(load_rig(reference), rotation_deg=degrees, translation_m=metres, seed=seed).save(
            far
        )
        warm = Case("warm-up", cases[0].folders, far, reference)
        run(warm, (tree, os.cpu_count() or 1), options.folder, WARM_UP_FRAMES)
    runs, settings = Runs(), list(product(trees, options.cores))
    for case, repeat, setting in product(cases, range(options.repeats), settings):
        found = run(case, setting, options.folder, options.frames)
        before = runs.get((case.name, setting), found)
        runs[case.name, setting] = Measured(
            min(before.wall_s, found.wall_s), min(before.cpu_s, found.cpu_s), found.result
        )
        where = f"{case.name}, {setting[0].name}, {setting[1]} cores, repeat {repeat + 1}"
        print(f"{where}: {found.wall_s:.1f} s, CPU {found.cpu_s:.1f} s", flush=True)
    publish("speed.paired", list(tables(cases, trees, options.cores, runs)), record=options.record)


def all_cases(data: Path | None, tree: Path, folder: Path) -> Iterator[Case]:
    """The sample, and the recordings with guesses drawn about their calibration."""
    sample = tree / "data" / "sample"
    yield Case("sample", (sample,), sample / "rig.yaml", sample / "reference.yaml")
    for (name, sequences), guess in product(SEQUENCES.items(), GUESSES) if data else ():
        folders = tuple(data / "sequences" / sequence for sequence in sequences)
        degrees, metres, seed = GUESSES[guess]
        rig = perturb(load_rig(folders[0]), rotation_deg=degrees, translation_m=metres, seed=seed,
                      uniform=True)  # fmt: skip
        path = folder / f"guess_{name}_{guess}.yaml"
        rig.save(path)
        yield Case(f"{name} {guess}", folders, path, folders[0])


def run(case: Case, setting: Setting, folder: Path, frames: str | None) -> Measured:
    """Run the command of a source tree once, bound to so many cores.

    Raises:
        SystemExit: if it writes no result.
    """
    tree, cores = setting
    own = folder / "_".join(tree.parts[1:])
    own_variables = {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(own / "cache")}
    names = [*map(str, case.folders), "--rig", str(case.guess), "--out", str(own / case.name)]
    names += [] if frames is None else ["--frames", frames]
    command = [sys.executable, "-m", "calibgraph", "calibrate", *names]
    every = os.sched_getaffinity(0)
    before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    os.sched_setaffinity(0, sorted(every)[:cores])
    try:
        done = subprocess.run(command, cwd=tree, env={**os.environ, **own_variables},
                              capture_output=True, text=True, check=False)  # fmt: skip
    finally:
        os.sched_setaffinity(0, every)
    wall_s, after = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 1):  # 1: the verdict is FAIL
        raise SystemExit(f"{case.name}, {tree}: {done.stderr.strip()}")
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measured(wall_s, cpu_s, load_calibration(own / case.name))


def version(tree: Path) -> str:
    """The commit of a source tree, or its name if it is not a checkout."""
    return commit(tree) if (tree / ".git").exists() else tree.name


def tables(
    cases: Sequence[Case], trees: Sequence[Path], cores: Sequence[int], runs: Runs
) -> Iterator[Table]:
    """Times before and after; errors, verdicts and differences; one core and more."""
    cores, names = sorted(cores), " and ".join(map(version, trees))
    rows = []
    for case, count in product(cases, cores):
        cells = [case.name, str(count)]
        for name in ("wall_s", "cpu_s"):
            old, new = (getattr(runs[case.name, (tree, count)], name) for tree in trees)
            cells += [f"{old:.1f}", f"{new:.1f}", f"{old / new:.2f}"]
        rows.append(tuple(cells))
    yield Table(f"Times, before and after: {names}", TIME_COLUMNS, tuple(rows))
    errors = [
        row
        for case in cases
        for row in error_cells(case, *(runs[case.name, (tree, cores[-1])] for tree in trees))
    ]
    yield Table(f"Errors, {cores[-1]} cores", ERROR_COLUMNS, tuple(errors))
    if len(cores) > 1:
        yield Table("Cores", CORE_COLUMNS, tuple(
            core_cells(case, tree, count, runs[case.name, (tree, cores[0])],
                       runs[case.name, (tree, count)])
            for case, tree, count in product(cases, dict.fromkeys(trees), cores)
        ))  # fmt: skip


def error_cells(case: Case, before: Measured, after: Measured) -> Iterator[tuple[str, ...]]:
    """A row for each camera."""
    results = before.result, after.result
    old, new = (evaluate(each.rig, load_rig(case.reference)).cameras for each in results)
    for name, change in evaluate(results[1].rig, results[0].rig).cameras.items():
        degrees = [f"{error[name].rotation_error_deg:.3f}" for error in (old, new)]
        centimetres = [f"{error[name].translation_error_cm:.2f}" for error in (old, new)]
        moved = f"{change.rotation_error_deg:.4f}", f"{change.translation_error_cm:.3f}"
        verdicts = [each.camera_verdicts[name].status for each in results]
        yield case.name, name, *degrees, *centimetres, *moved, *verdicts


def core_cells(case: Case, tree: Path, count: int, one: Measured, many: Measured
               ) -> tuple[str, ...]:  # fmt: skip
    """How much faster many cores are than one, and how far the result is from that of one."""
    changes = evaluate(many.result.rig, one.result.rig).cameras.values()
    degrees = max(change.rotation_error_deg for change in changes)
    centimetres = max(change.translation_error_cm for change in changes)
    numbers = f"{many.wall_s:.1f}", f"{one.wall_s / many.wall_s:.2f}"
    return case.name, version(tree), str(count), *numbers, f"{degrees:.2g}", f"{centimetres:.2g}"


if __name__ == "__main__":
    main()
