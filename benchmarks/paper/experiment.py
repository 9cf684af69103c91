"""The paper's experiment over many draws: each method's errors as medians with 90 % intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from benchmarks.paper.methods import STAGE1, PreparedDraw, run_methods
from benchmarks.paper.sources import Source
from calibgraph.model.config import Config
from calibgraph.model.metrics import PoseError, evaluate
from calibgraph.model.rig import Rig
from calibgraph.progress import Progress, no_progress
from calibgraph.solver.camera_block import CameraBlock, camera_blocks
from calibgraph.solver.objective import Transforms

Numbers = dict[str, dict[str, float]]
"""Per camera, or per pair ``A->B`` of neighbours: metrics by name, without signs."""

QUANTILES = (0.05, 0.5, 0.95)
IMPROVEMENT = "reprojection_improvement_px"
REPROJECTION = "reprojection_px"
ROTATION, TRANSLATION = "rotation_error_deg", "translation_error_cm"


@dataclass(frozen=True, eq=False)
class Task:
    """One draw to run, possibly in another process.

    Attributes:
        source: of the draw.
        frames: number of frames.
        seed: of everything random in it.
        config: the paper's settings for it.
        trf: whether to run the paper's solver.
    """

    source: Source
    frames: int
    seed: int
    config: Config
    trf: bool


@dataclass(frozen=True)
class DrawResult:
    """The errors of all methods on one draw.

    Attributes:
        numbers: per reference and row; None for a row that failed.
        seconds: per row.
    """

    numbers: dict[str, dict[str, Numbers | None]]
    seconds: dict[str, float]


@dataclass(frozen=True)
class Interval:
    """A median over draws with its 5 % and 95 % quantiles."""

    low: float
    median: float
    high: float


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
    """All methods, for one number of frames and one reference."""

    frames: int
    reference: str
    draws: int
    rows: dict[str, Row]


@dataclass(frozen=True)
class Report:
    """The whole experiment.

    Attributes:
        data: name of the source.
        published_as: the paper's data set to compare with, or "".
        preset: the paper's settings for its rows.
        seed: of everything random.
        blocks: per number of frames and reference.
    """

    data: str
    published_as: str
    preset: str
    seed: int
    blocks: tuple[Block, ...]

    @property
    def is_empty(self) -> bool:
        """Whether every method failed in every draw."""
        return all(row.failed == b.draws for b in self.blocks for row in b.rows.values())


def run_experiment(
    source: Source,
    *,
    frames: Sequence[int],
    draws: int,
    config: Config,
    seed: int = 0,
    jobs: int = 1,
    trf: bool = True,
    progress: Progress = no_progress,
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
        progress: called with the number of draws done.

    Raises:
        ValueError: if there is no draw, no frame or no process.
    """
    if draws < 1 or jobs < 1 or not frames or min(frames) < 1:
        raise ValueError(f"nothing to do: {draws} draws of {list(frames)} frames in {jobs} jobs")
    sizes = dict.fromkeys(source.frame_count(n) for n in frames)
    tasks = [
        Task(source, n, seed=draw_seed(seed, n, index), config=config, trf=trf)
        for n in sizes
        for index in range(draws)
    ]
    found = _run(tasks, jobs, progress)
    parts = [_summarize(n, found[k * draws : (k + 1) * draws]) for k, n in enumerate(sizes)]
    blocks = tuple(block for part in parts for block in part)
    return Report(source.name, source.published_as, config.preset, seed, blocks)


def draw_seed(seed: int, frames: int, index: int) -> int:
    """The seed of one draw."""
    return int(np.random.SeedSequence([seed, frames, index]).generate_state(1)[0] >> 1)


def _run(tasks: Sequence[Task], jobs: int, progress: Progress) -> list[DrawResult]:
    """The results of all draws, in the order of the tasks."""
    if jobs == 1:
        done = []
        for index, task in enumerate(tasks):
            progress(f"draws of {task.frames} frames", index, len(tasks))
            done.append(run_draw(task))
        return done
    with ProcessPoolExecutor(min(jobs, len(tasks)), get_context("spawn")) as pool:
        futures = [pool.submit(run_draw, task) for task in tasks]
        for count, _ in enumerate(as_completed(futures), start=1):
            progress("draws", count, len(tasks))
        return [future.result() for future in futures]


def run_draw(task: Task) -> DrawResult:
    """Draw, run every method, compare it with every reference."""
    draw = task.source.draw(task.frames, task.seed)
    prepared = PreparedDraw.prepare(draw, task.config, task.seed)
    blocks = camera_blocks(draw.rig, prepared.table, task.config)
    runs = list(run_methods(prepared, trf=task.trf))
    medians_px = {row: {} if T is None else reprojection_px(blocks, T) for row, T, _ in runs}
    numbers: dict[str, dict[str, Numbers | None]] = {
        name: {
            row: None
            if T is None
            else absolute_errors(draw.rig, T, reference, medians_px[row], medians_px[STAGE1])
            for row, T, _ in runs
        }
        for name, reference in draw.references.items()
    }
    return DrawResult(numbers, {row: seconds for row, _, seconds in runs})


def reprojection_px(
    blocks: Mapping[str, CameraBlock], T_camera_lidar: Transforms
) -> dict[str, float]:
    """Per camera the median reprojection error of its preprocessed correspondences."""
    return {
        name: float(np.median(block.errors_px(T_camera_lidar[name])[0]))
        for name, block in blocks.items()
    }


def absolute_errors(
    rig: Rig,
    T_camera_lidar: Transforms,
    reference: Rig,
    medians_px: Mapping[str, float],
    stage1_px: Mapping[str, float],
) -> Numbers:
    """The paper's metrics of extrinsics against a reference, without signs.

    Args:
        rig: the order of the cameras; the relative pose is evaluated for neighbours in it.
        T_camera_lidar: (4, 4) per camera.
        reference: to compare with.
        medians_px: median reprojection error per camera.
        stage1_px: the same of Stage 1; empty if there is none.
    """
    errors = evaluate(rig.moved_to(T_camera_lidar), reference)
    metrics = {name: _without_signs(error) for name, error in errors.cameras.items()}
    for name, median in medians_px.items():
        metrics[name][REPROJECTION] = median
        metrics[name][IMPROVEMENT] = stage1_px.get(name, np.nan) - median
    for a, b in pairwise(rig.cameras):
        metrics[f"{a}->{b}"] = _without_signs(errors.pairs[f"{a}->{b}"])
    return metrics


def _without_signs(error: PoseError) -> dict[str, float]:
    return {metric: abs(value) for metric, value in asdict(error).items()}


def _summarize(frames: int, results: Sequence[DrawResult]) -> Iterator[Block]:
    """A block per reference."""
    for reference in results[0].numbers:
        rows = {
            row: _row(
                [r.numbers[reference][row] for r in results], [r.seconds[row] for r in results]
            )
            for row in results[0].numbers[reference]
        }
        yield Block(frames, reference, len(results), rows)


def _row(numbers: Sequence[Numbers | None], seconds: Sequence[float]) -> Row:
    solved = [n for n in numbers if n is not None]
    summary = {
        name: {m: interval([n[name][m] for n in solved]) for m in metrics}
        for name, metrics in (solved[0].items() if solved else ())
    }
    return Row(summary, len(numbers) - len(solved), float(np.median(seconds)))


def interval(values: Sequence[float]) -> Interval:
    """Median, 5 % and 95 % quantile of the values that are not NaN; NaN without any."""
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return Interval(np.nan, np.nan, np.nan)
    low, median, high = np.quantile(known, QUANTILES)
    return Interval(float(low), float(median), float(high))
