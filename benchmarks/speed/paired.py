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

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from benchmarks.tables import Table, commit, parser_of, publish
from calibgraph import Calibration, evaluate, load_calibration, load_rig, perturb

SEQUENCES = {"00": ("00",), "05-08": ("05", "06", "07", "08")}
GUESSES = {"20deg": (20.0, 1.5, 5), "2deg": (2.0, 0.2, 0)}
"""Degrees and metres per axis, and the seed."""
WARM_UP_FRAMES = "0:2"


@dataclass(frozen=True)
class Case:
    """What is calibrated.

    Attributes:
        name: such as ``05-08 20deg``.
        folders: of the dataset.
        guess: file of the rig.
        reference: folder or file of the rig.
    """

    name: str
    folders: tuple[Path, ...]
    guess: Path
    reference: Path


@dataclass(frozen=True)
class Setting:
    """What runs a case: a source tree, on so many cores."""

    tree: Path
    cores: int


@dataclass(frozen=True, eq=False)
class Measured:
    """A case in one setting.

    Attributes:
        wall_s, cpu_s: the shortest of the repeats.
        result: of the last repeat.
    """

    wall_s: float
    cpu_s: float
    result: Calibration


Runs = dict[tuple[str, Setting], Measured]


def main() -> None:
    """Run all cases in all settings, and compare."""
    options = parse_options()
    trees = [options.before.resolve(), options.after.resolve()]
    settings = [Setting(tree, cores) for tree, cores in product(trees, options.cores)]
    options.folder.mkdir(parents=True, exist_ok=True)
    cases = [case for case in all_cases(options.data, trees[1], options.folder)
             if not options.cases or case.name in options.cases]  # fmt: skip
    for tree in dict.fromkeys(trees):
        print(f"{tree.name}: compiling", flush=True)
        warm_up(tree, cases[0], options.folder)
    runs = Runs()
    for case, repeat, setting in product(cases, range(options.repeats), settings):
        measured = run(case, setting, options.folder, options.frames)
        before = runs.get((case.name, setting), measured)
        shortest = (min(getattr(m, of) for m in (before, measured)) for of in ("wall_s", "cpu_s"))
        runs[case.name, setting] = Measured(*shortest, measured.result)
        seconds = f"{measured.wall_s:.1f} s, CPU {measured.cpu_s:.1f} s"
        print(f"{case.name}, {label(setting)}, repeat {repeat + 1}: {seconds}", flush=True)
    publish("speed.paired", list(tables(cases, settings, runs)), record=options.record)


def parse_options() -> argparse.Namespace:
    """The options."""
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
    return parser.parse_args()


def all_cases(data: Path | None, tree: Path, folder: Path) -> Iterator[Case]:
    """The sample, and the recordings with guesses drawn about their calibration."""
    sample = tree / "data" / "sample"
    yield Case("sample", (sample,), sample / "rig.yaml", sample / "reference.yaml")
    if data is None:
        return
    for (name, sequences), guess in product(SEQUENCES.items(), GUESSES):
        folders = tuple(data / "sequences" / sequence for sequence in sequences)
        degrees, metres, seed = GUESSES[guess]
        reference = load_rig(folders[0])
        rig = perturb(
            reference, rotation_deg=degrees, translation_m=metres, seed=seed, uniform=True
        )
        path = folder / f"guess_{name}_{guess}.yaml"
        rig.save(path)
        yield Case(f"{name} {guess}", folders, path, folders[0])


def warm_up(tree: Path, case: Case, folder: Path) -> None:
    """Compile a tree's kernels, those of the search too: it starts at a far guess."""
    reference = load_rig(case.reference)
    degrees, metres, seed = GUESSES["20deg"]
    far = folder / "far.yaml"
    perturb(reference, rotation_deg=degrees, translation_m=metres, seed=seed).save(far)
    warm = Case("warm-up", case.folders, far, case.reference)
    calibrate(warm, Setting(tree, os.cpu_count() or 1), folder, WARM_UP_FRAMES)


def run(case: Case, setting: Setting, folder: Path, frames: str | None) -> Measured:
    """Run a case once."""
    before, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    out = calibrate(case, setting, folder, frames)
    wall_s, after = time.perf_counter() - wall, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Measured(wall_s, cpu_s, load_calibration(out))


def calibrate(case: Case, setting: Setting, folder: Path, frames: str | None) -> Path:
    """Run the command of a source tree; the folder of its result.

    Raises:
        SystemExit: if it writes no result.
    """
    tree = setting.tree
    own = folder / "_".join(tree.parts[1:])
    out = own / case.name
    own_variables = {"PYTHONPATH": str(tree), "NUMBA_CACHE_DIR": str(own / "cache")}
    environment = {**os.environ, **own_variables}
    names = [*map(str, case.folders), "--rig", str(case.guess), "--out", str(out)]
    names += [] if frames is None else ["--frames", frames]
    command = [sys.executable, "-m", "calibgraph", "calibrate", *names]
    with bound_to(setting.cores):
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, check=False
        )
    if done.returncode not in (0, 1):  # 1: the verdict is FAIL
        raise SystemExit(f"{case.name}, {tree}: {done.stderr.strip()}")
    return out


@contextmanager
def bound_to(cores: int) -> Iterator[None]:
    """Start processes on so many cores."""
    every = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(every)[:cores])
    try:
        yield
    finally:
        os.sched_setaffinity(0, every)


def version(tree: Path) -> str:
    """The commit of a source tree, or its name if it is not a checkout."""
    return commit(tree) if (tree / ".git").exists() else tree.name


def label(setting: Setting) -> str:
    """A setting in words."""
    return f"{setting.tree.name}, {setting.cores} cores"


def tables(cases: Sequence[Case], settings: Sequence[Setting], runs: Runs) -> Iterator[Table]:
    """Times before and after; errors, verdicts and differences; one core and more."""
    cores = sorted({setting.cores for setting in settings})
    before, after = settings[0].tree, settings[-1].tree
    pairs = [
        (case, (runs[case.name, Setting(before, n)], runs[case.name, Setting(after, n)]), n)
        for case, n in product(cases, cores)
    ]
    names = " and ".join(version(tree) for tree in (before, after))
    yield Table(
        f"Times, before and after: {names}",
        TIME_COLUMNS,
        tuple(time_cells(case, n, pair) for case, pair, n in pairs),
    )
    rows = [row for case, pair, n in pairs if n == cores[-1] for row in error_cells(case, pair)]
    yield Table(f"Errors, {cores[-1]} cores", ERROR_COLUMNS, tuple(rows))
    if len(cores) > 1:
        yield Table("Cores", CORE_COLUMNS, tuple(core_cells(cases, (before, after), cores, runs)))


TIME_COLUMNS = ("case", "cores", "wall before [s]", "after", "ratio", "CPU before [s]", "after",
                "ratio")  # fmt: skip
ERROR_COLUMNS = ("case", "camera", "before [deg]", "after", "before [cm]", "after",
                 "difference [deg]", "[cm]", "verdict before", "after")  # fmt: skip
CORE_COLUMNS = ("case", "tree", "cores", "wall [s]", "speed-up", "difference [deg]", "[cm]")


def time_cells(case: Case, cores: int, pair: tuple[Measured, Measured]) -> tuple[str, ...]:
    """A row of the first table."""
    cells = [case.name, str(cores)]
    for name in ("wall_s", "cpu_s"):
        old, new = (getattr(measured, name) for measured in pair)
        cells += [f"{old:.1f}", f"{new:.1f}", f"{old / new:.2f}"]
    return tuple(cells)


def error_cells(case: Case, pair: tuple[Measured, Measured]) -> Iterator[tuple[str, ...]]:
    """A row of the second table for each camera."""
    reference = load_rig(case.reference)
    old, new = (evaluate(measured.result.rig, reference).cameras for measured in pair)
    between = evaluate(pair[1].result.rig, pair[0].result.rig).cameras
    for name in old:
        degrees = [f"{error[name].rotation_error_deg:.3f}" for error in (old, new)]
        centimetres = [f"{error[name].translation_error_cm:.2f}" for error in (old, new)]
        verdicts = [measured.result.camera_verdicts[name].status for measured in pair]
        change = between[name]
        moved = f"{change.rotation_error_deg:.4f}", f"{change.translation_error_cm:.3f}"
        yield case.name, name, *degrees, *centimetres, *moved, *verdicts


def core_cells(
    cases: Sequence[Case], trees: tuple[Path, Path], cores: Sequence[int], runs: Runs
) -> Iterator[tuple[str, ...]]:
    """A row of the third table for each tree and number of cores."""
    for case, tree, count in product(cases, dict.fromkeys(trees), cores):
        one, many = (runs[case.name, Setting(tree, n)] for n in (cores[0], count))
        changes = evaluate(many.result.rig, one.result.rig).cameras.values()
        degrees = max(change.rotation_error_deg for change in changes)
        centimetres = max(change.translation_error_cm for change in changes)
        numbers = f"{many.wall_s:.1f}", f"{one.wall_s / many.wall_s:.2f}"
        moved = f"{degrees:.2g}", f"{centimetres:.2g}"
        yield case.name, version(tree), str(count), *numbers, *moved


if __name__ == "__main__":
    main()
