"""Processor time as ratios against well-known baselines, all of one run; fails if one has grown.

    python -m benchmarks.speed.gate                   print, and write out/ratios.json
    python -m benchmarks.speed.gate --against FILE    fail where one is over 1.25 times that of FILE
    python -m benchmarks.speed.gate --write           keep them as those of this release

A ratio is of the shortest processor times of a call and of its baseline, in turns, on one thread:
so slower machines change it little, and other load less than times. Baselines: a matrix product
(sgemm, 1024 rows), SciPy's TRF, a GTSAM factor per correspondence, a copy of memory as large as the
table.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.speed.incremental import GUESS, frames
from benchmarks.speed.kernel import MATRIX, ONE_THREAD, matcher_calls, shortest
from benchmarks.speed.solvers import Problem, solve_gtsam_python, solve_ours_once, solve_trf_once
from benchmarks.tables import ROOT, Table
from calibgraph import (
    IncrementalCalibrator,
    calibrate,
    load_correspondences,
    load_dataset,
    solve,
)
from calibgraph.tracking import warm_up_tracker

RELEASE = ROOT / "benchmarks" / "ratios.json"
SAMPLE = ROOT / "data" / "sample"
WORST = 1.25
_TRIES = 3  # other work takes the caches of both, but not equally
_SMALL, _LARGE, _FACTORS = (10, 2), (100, 2), (10, 2)  # frames and cameras
_UPDATES = 120  # of a tracker, the first half of which is not timed
_ROWS_OF_COPY = 20  # copies of the table per run: one is too short to time

Ratios = dict[str, float]


def main() -> int:
    """Measure, print, write, compare."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--against", type=Path, help="ratios of a release")
    parser.add_argument("--write", action="store_true", help=f"to {RELEASE.relative_to(ROOT)}")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "ratios.json")
    options = parser.parse_args()
    if any(os.environ.get(name) != value for name, value in ONE_THREAD.items()):
        environment = {**os.environ, **ONE_THREAD, "NUMBA_NUM_THREADS": "1"}
        os.execve(sys.executable, [sys.executable, "-m", __spec__.name, *sys.argv[1:]], environment)
    former = json.loads(options.against.read_text("utf-8")) if options.against else {}
    found = measure(options.repeats, former)
    for path in (options.out, *([RELEASE] if options.write else [])):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(compare(found, former).text())
    worse = slower(found, former)
    for name in worse:
        print(f"{name}: {found[name]:.3g} is over {WORST} times {former[name]:.3g}")
    return 1 if worse else 0


def measure(repeats: int, former: Ratios) -> Ratios:
    """All ratios: smaller is faster. Those that fail are measured again, and the smaller counts."""
    found: Ratios = {}
    for part in (kernel, solves, updates, reading, whole):
        ratios = dict(part(repeats))
        for _ in range(_TRIES - 1):
            if slower(ratios, former):
                ratios = {name: min(ratios[name], again) for name, again in part(repeats)}
        found |= ratios
    return found


def kernel(repeats: int) -> Iterator[tuple[str, float]]:
    """Window scores, per multiply-add of their definition, over those of sgemm."""
    calls = matcher_calls(load_dataset(SAMPLE))

    def run() -> None:
        for call in calls:
            call.run()

    seconds, product = shortest(run, _sgemm(), repeats=repeats)
    work = sum(call.multiply_adds() for call in calls)
    yield "window scores / sgemm, per multiply-add", seconds / work / (product / MATRIX**3)


def solves(repeats: int) -> Iterator[tuple[str, float]]:
    """Whole calls over one pass of TRF; one pass over one with a factor per correspondence."""
    for size in (_SMALL, _LARGE):
        problem = Problem.draw(*size)
        ours, trf = shortest(
            partial(solve, problem.rig, problem.table),
            partial(solve_trf_once, problem),
            repeats=repeats,
        )
        yield f"solve / one pass of TRF, {size[1]} x {size[0]} x 1000", ours / trf
    problem = Problem.draw(*_FACTORS)
    ours, gtsam = shortest(
        partial(solve_ours_once, problem), partial(solve_gtsam_python, problem), repeats=repeats
    )
    yield "one pass / GTSAM, a factor per correspondence", ours / gtsam


def updates(repeats: int) -> Iterator[tuple[str, float]]:
    """A tracker's frames over a matrix product."""
    warm_up_tracker()
    tables = list(frames(_UPDATES))

    def track() -> None:
        tracker = IncrementalCalibrator(GUESS)
        for table in tables:
            tracker.update(table)

    seconds, product = shortest(track, _sgemm(), repeats=repeats)
    yield "update of two cameras / sgemm", seconds / _UPDATES / product


def reading(repeats: int) -> Iterator[tuple[str, float]]:
    """A table from Parquet over a copy of its columns."""
    problem = Problem.draw(*_LARGE)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "correspondences.parquet"
        problem.table.save(path)
        columns = [problem.table.pixels_px, problem.table.points_lidar_m]

        def copy() -> None:
            for _ in range(_ROWS_OF_COPY):
                for column in columns:
                    column.copy()

        seconds, copies = shortest(partial(load_correspondences, path), copy, repeats=repeats)
    yield "table from Parquet / copy of memory", seconds / (copies / _ROWS_OF_COPY)


def whole(repeats: int) -> Iterator[tuple[str, float]]:
    """`calibrate` of the sample over a matrix product."""
    dataset = load_dataset(SAMPLE)
    dataset = replace(dataset, frames=dataset.frames[:2])
    seconds, product = shortest(partial(calibrate, dataset), _sgemm(), repeats=min(repeats, 2))
    yield "calibrate of two frames of the sample / sgemm", seconds / product


def _sgemm() -> Callable[[], object]:
    matrix = np.random.default_rng(0).random((MATRIX, MATRIX), np.float32)
    return partial(np.matmul, matrix, matrix, np.empty_like(matrix))


def slower(found: Ratios, former: Ratios) -> list[str]:
    """The names of ratios over ``WORST`` times those of a release."""
    return [name for name in found if name in former and found[name] > WORST * former[name]]


def compare(found: Ratios, former: Ratios) -> Table:
    """A row per ratio."""
    rows = [
        (name, f"{value:.4g}", f"{value / former[name]:.2f}" if name in former else "")
        for name, value in found.items()
    ]
    return Table(
        "Processor time", ("ratio of processor times", "now", "over the release's"), tuple(rows)
    )


if __name__ == "__main__":
    sys.exit(main())
