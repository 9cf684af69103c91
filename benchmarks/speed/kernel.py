"""The matcher's kernel: multiply-adds a second, beside those of a matrix product (sgemm).

    python -m benchmarks.speed.kernel [--dataset data/sample] [--repeats 7]

The kernel `score_windows` correlates LiDAR windows with the image at every shift of a grid. Its
calls are those of the matcher, for the first camera and frame of a dataset: one in each round, and
that of the search. Counted is what the definition of the score needs, however it is computed: for
each point and shift at which its window is in the image, a product with depth, with intensity, with
one, with itself, and with both trends where these are not zero. Both run on one thread, in turns;
the shortest processor times count.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph import Dataset, Rig, StructureMatcher, load_dataset, perturb
from calibgraph.matching.structure import correlation_maps, shift_scores
from calibgraph.progress import no_progress

MATRIX = 1024  # rows of the square matrices
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
FAR_DEG, FAR_M = 15.0, 1.0  # of a guess that is not accepted, so that a search begins
COLUMNS = ("call", "windows", "grid", "1e9 multiply-adds", "time [ms]", "1e9 a second",
           "of sgemm")  # fmt: skip


class _EnoughError(Exception):
    """The search has made its call."""


@dataclass(frozen=True, eq=False)
class Call:
    """One call of the kernel.

    Attributes:
        name: what called it.
        arguments: by the names of its parameters.
    """

    name: str
    arguments: dict[str, Any]

    @property
    def windows(self) -> int:
        """Number of windows."""
        return len(self.arguments["counts"])

    def run(self) -> None:
        """Call the kernel again; it adds to the same grids."""
        shift_scores.score_windows(*self.arguments.values())

    def multiply_adds(self) -> int:
        """Multiply-adds by the definition of the score."""
        a = self.arguments
        size = np.array(a["grids"].shape[:0:-1])  # columns, rows
        image = np.array(a["image"].shape[::-1])
        low, high = a["places"].min(axis=1), a["places"].max(axis=1)
        first = np.maximum(a["origin"], -low)
        shifts = np.maximum(0, np.minimum(a["origin"] + size, image - high) - first).prod(axis=1)
        products = 4 + 2 * np.any(a["basis"][:, :, 2:], axis=(1, 2))
        return int(np.sum(a["counts"] * shifts * products))


def matcher_calls(dataset: Dataset) -> list[Call]:
    """The kernel's calls for one camera and frame: by the search, and in each round."""
    name = next(iter(dataset.rig.cameras))
    rig, one = Rig(cameras={name: dataset.rig.cameras[name]}), dataset.select("0")
    matcher, calls = StructureMatcher(), list[Call]()
    far = perturb(rig, rotation_deg=FAR_DEG, translation_m=FAR_M)
    with recorded(correlation_maps, "search", calls, stop=True), contextlib.suppress(_EnoughError):
        matcher.locate(one, far, out_of_time=lambda: False, progress=no_progress)
    for index in range(matcher.rounds):
        with recorded(shift_scores, f"round {index + 1}", calls):
            matcher.match(one, rig, round_index=index, progress=no_progress)
    return calls


@contextmanager
def recorded(module: Any, name: str, calls: list[Call], *, stop: bool = False) -> Iterator[None]:
    """Record the calls of the kernel that a module makes; with ``stop``, none goes on."""
    kernel = module.score_windows
    signature = inspect.signature(getattr(kernel, "py_func", kernel))

    def record(*arguments: Any) -> None:
        calls.append(Call(name, dict(signature.bind(*arguments).arguments)))
        if stop:
            raise _EnoughError
        kernel(*arguments)

    module.score_windows = record
    try:
        yield
    finally:
        module.score_windows = kernel


def shortest(*runs: Callable[[], object], repeats: int) -> list[float]:
    """The shortest processor seconds of each function, run in turns."""
    seconds = np.full(len(runs), np.inf)
    for index in list(range(len(runs))) * (1 + repeats):  # the first turn compiles
        start = time.process_time()
        runs[index]()
        seconds[index] = min(seconds[index], time.process_time() - start)
    return [float(value) for value in seconds]


def measure(call: Call, repeats: int) -> tuple[str, ...]:
    """The row of a call."""
    matrix = np.random.default_rng(0).random((MATRIX, MATRIX), np.float32)
    out = np.empty_like(matrix)
    seconds, sgemm_s = shortest(call.run, lambda: np.matmul(matrix, matrix, out), repeats=repeats)
    work = call.multiply_adds()
    rate, sgemm_rate = work / seconds, MATRIX**3 / sgemm_s
    height, width = call.arguments["grids"].shape[1:]
    return (
        call.name, str(call.windows), f"{width}x{height}", f"{work / 1e9:.3f}",
        f"{1e3 * seconds:.1f}", f"{rate / 1e9:.2f}", f"{rate / sgemm_rate:.1%}",
    )  # fmt: skip


def main() -> None:
    """Print the table; on one thread, which BLAS only takes from the environment at its start."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", type=Path, default=ROOT / "data" / "sample")
    parser.add_argument("--repeats", type=int, default=7)
    add_record_option(parser)
    options = parser.parse_args()
    if not ONE_THREAD.items() <= os.environ.items():
        command = [sys.executable, "-m", "benchmarks.speed.kernel", *sys.argv[1:]]
        os.execve(sys.executable, command, {**os.environ, **ONE_THREAD})
    rows = [measure(call, options.repeats) for call in matcher_calls(load_dataset(options.dataset))]
    publish("speed.kernel", [Table("Multiply-adds", COLUMNS, tuple(rows))], record=options.record)


if __name__ == "__main__":
    main()
