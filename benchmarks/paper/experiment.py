"""The paper's experiment over many draws: each method's errors as medians with 90 % intervals."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from benchmarks.paper.draws import STAGE1, PreparedDraw, Source, run_methods
from calibgraph.model.config import Config
from calibgraph.model.metrics import evaluate
from calibgraph.solver.camera_block import camera_blocks

Numbers = dict[str, dict[str, float]]
"""Per camera, or per pair ``A->B`` of neighbours: metrics by name, without signs."""
Interval = tuple[float, float, float]
"""The 5 % quantile over draws, the median, the 95 % quantile."""

QUANTILES = (0.05, 0.5, 0.95)
IMPROVEMENT = "reprojection_improvement_px"
REPROJECTION = "reprojection_px"
ROTATION, TRANSLATION = "rotation_error_deg", "translation_error_cm"


@dataclass(frozen=True)
class Row:
    """One method over all draws.

    Attributes:
        numbers: per camera or pair, and metric.
        failed: number of draws in which it failed; they are not in the intervals.
        seconds: median time of a draw.
    """

    numbers: dict[str, dict[str, Interval]]
    failed: int
    seconds: float


@dataclass(frozen=True)
class Block:
    """All methods, for one number of frames."""

    frames: int
    draws: int
    rows: dict[str, Row]


@dataclass(frozen=True)
class Report:
    """The whole experiment; ``published_as``: the paper's data set to compare with, or ""."""

    data: str
    published_as: str
    preset: str
    seed: int
    blocks: tuple[Block, ...]

    @property
    def is_empty(self) -> bool:
        """Whether every method failed in every draw."""
        return all(row.failed == b.draws for b in self.blocks for row in b.rows.values())


DrawResult = dict[str, tuple[Numbers | None, float]]
"""Per row its errors, None if it failed, and its seconds."""


def run_experiment(
    source: Source,
    *,
    frames: Sequence[int],
    draws: int,
    config: Config,
    seed: int = 0,
    jobs: int = 1,
    trf: bool = True,
) -> Report:
    """Run the paper's protocol: draws with a new guess each, evaluated by its metrics.

    Args:
        source: of the draws.
        frames: numbers of frames N.
        draws: of each N.
        config: the paper's settings, for its solver and for the per-camera adjustment.
        seed: of everything random; the same seed gives the same numbers.
        jobs: processes.
        trf: whether to run the paper's own solver, which takes minutes at N = 100.

    Raises:
        ValueError: if there is no draw, no frame or no process.
    """
    if draws < 1 or jobs < 1 or not frames or min(frames) < 1:
        raise ValueError(f"nothing to do: {draws} draws of {list(frames)} frames in {jobs} jobs")
    sizes = [*dict.fromkeys(source.frame_count(n) for n in frames)]
    tasks = [(n, draw_seed(seed, n, index)) for n in sizes for index in range(draws)]
    run, found = partial(run_draw, source, config=config, trf=trf), list[DrawResult]()
    with ProcessPoolExecutor(min(jobs, len(tasks)), get_context("spawn")) as pool:
        for result in pool.map(run, tasks) if jobs > 1 else map(run, tasks):
            found.append(result)
            print(f"draws: {len(found)} of {len(tasks)}", file=sys.stderr)
    blocks = (_summarize(n, found[k * draws : (k + 1) * draws]) for k, n in enumerate(sizes))
    return Report(source.name, source.published_as, config.preset, seed, tuple(blocks))


def draw_seed(seed: int, frames: int, index: int) -> int:
    """The seed of one draw."""
    return int(np.random.SeedSequence([seed, frames, index]).generate_state(1)[0] >> 1)


def run_draw(source: Source, task: tuple[int, int], *, config: Config, trf: bool) -> DrawResult:
    """Draw, run every method, compare it with the reference by the paper's metrics."""
    frames, seed = task
    draw = source.draw(frames, seed)
    prepared = PreparedDraw.prepare(draw, config, seed)
    blocks = camera_blocks(draw.rig, prepared.table, config)
    runs = list(run_methods(prepared, trf=trf))
    medians_px = {
        row: {} if T is None else {
            name: float(np.median(block.errors_px(T[name])[0])) for name, block in blocks.items()
        }
        for row, T, _ in runs
    }  # fmt: skip
    found: DrawResult = {}
    for row, T, seconds in runs:
        metrics: Numbers | None = None
        if T is not None:
            errors = evaluate(draw.rig.moved_to(T), draw.reference)
            pairs = {f"{a}->{b}" for a, b in pairwise(draw.rig.cameras)}
            kept = {n: e for n, e in errors.pairs.items() if n in pairs}
            metrics = {name: {metric: abs(value) for metric, value in asdict(error).items()}
                       for name, error in {**errors.cameras, **kept}.items()}  # fmt: skip
            for name, median in medians_px[row].items():
                metrics[name][REPROJECTION] = median
                metrics[name][IMPROVEMENT] = medians_px[STAGE1].get(name, np.nan) - median
        found[row] = metrics, seconds
    return found


def _summarize(frames: int, results: Sequence[DrawResult]) -> Block:
    rows = {}
    for row in results[0]:
        solved = [one[row][0] for one in results if one[row][0] is not None]
        summary = {
            name: {m: interval([n[name][m] for n in solved]) for m in metrics}
            for name, metrics in (solved[0].items() if solved else ())
        }
        seconds = float(np.median([one[row][1] for one in results]))
        rows[row] = Row(summary, len(results) - len(solved), seconds)
    return Block(frames, len(results), rows)


def interval(values: Sequence[float]) -> Interval:
    """Median, 5 % and 95 % quantile of the values that are not NaN; NaN without any."""
    known = [value for value in values if not np.isnan(value)]
    low, median, high = np.quantile(known, QUANTILES) if known else [np.nan] * 3
    return float(low), float(median), float(high)
