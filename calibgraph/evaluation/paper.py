"""The paper's experiment over many draws: errors of every way, as medians with 90 % intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from calibgraph.evaluation.methods import STAGE1, Bench, run_all
from calibgraph.evaluation.sources import Source
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
    """One draw to be done, perhaps by another process.

    Attributes:
        source: where it comes from.
        frames: how many.
        seed: of everything in it.
        config: the paper's settings for it.
        trf: whether SciPy's solver takes part.
    """

    source: Source
    frames: int
    seed: int
    config: Config
    trf: bool


@dataclass(frozen=True)
class Drawn:
    """What all ways made of one draw.

    Attributes:
        numbers: per reference and row; None for a row that found no poses.
        seconds: per row.
    """

    numbers: dict[str, dict[str, Numbers | None]]
    seconds: dict[str, float]


@dataclass(frozen=True)
class Interval:
    """A median over draws, and what 90 % of them lie between."""

    low: float
    median: float
    high: float


@dataclass(frozen=True)
class Row:
    """A way over all draws.

    Attributes:
        numbers: per camera or pair, and metric.
        failed: how many draws it found no poses in; they are not in the intervals.
        seconds: median time of a draw.
    """

    numbers: dict[str, dict[str, Interval]]
    failed: int
    seconds: float


@dataclass(frozen=True)
class Block:
    """All ways, for one number of frames and one reference."""

    frames: int
    reference: str
    draws: int
    rows: dict[str, Row]


@dataclass(frozen=True)
class Report:
    """The whole benchmark.

    Attributes:
        data: what was drawn from.
        published_as: which of the paper's data it is to be compared with; may be none.
        preset: the paper's settings that were used for its rows.
        seed: of everything.
        blocks: per number of frames and reference.
    """

    data: str
    published_as: str
    preset: str
    seed: int
    blocks: tuple[Block, ...]

    @property
    def is_empty(self) -> bool:
        """Whether no way found poses in any draw."""
        return all(row.failed == b.draws for b in self.blocks for row in b.rows.values())


def bench_paper(
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
    """Run the paper's protocol: so many draws, each with a new guess, judged by its metrics.

    Args:
        source: what to draw from.
        frames: numbers of frames N.
        draws: of each N.
        config: the paper's settings: for its solver and for what is solved camera by camera.
        seed: of everything; the same gives the same numbers.
        jobs: processes.
        trf: whether the paper's own solver takes part, which takes minutes at N = 100.
        progress: to be told.

    Raises:
        ValueError: if there is nothing to do.
    """
    if draws < 1 or jobs < 1 or not frames or min(frames) < 1:
        raise ValueError(f"nothing to do: {draws} draws of {list(frames)} frames in {jobs} jobs")
    sizes = dict.fromkeys(source.frames_at(n) for n in frames)
    tasks = [
        Task(source, n, seed=draw_seed(seed, n, index), config=config, trf=trf)
        for n in sizes
        for index in range(draws)
    ]
    drawn = _run(tasks, jobs, progress)
    blocks = [
        block
        for k, n in enumerate(sizes)
        for block in _summaries(n, drawn[k * draws : (k + 1) * draws])
    ]
    return Report(source.name, source.published_as, config.preset, seed, tuple(blocks))


def draw_seed(seed: int, frames: int, index: int) -> int:
    """A seed of one draw."""
    return int(np.random.SeedSequence([seed, frames, index]).generate_state(1)[0] >> 1)


def _run(tasks: Sequence[Task], jobs: int, progress: Progress) -> list[Drawn]:
    """All draws, in the order of the tasks."""
    if jobs == 1:
        done = []
        for index, task in enumerate(tasks):
            progress(f"draws of {task.frames} frames", index, len(tasks))
            done.append(one_draw(task))
        return done
    with ProcessPoolExecutor(min(jobs, len(tasks)), get_context("spawn")) as pool:
        futures = [pool.submit(one_draw, task) for task in tasks]
        for count, _ in enumerate(as_completed(futures), start=1):
            progress("draws", count, len(tasks))
        return [future.result() for future in futures]


def one_draw(task: Task) -> Drawn:
    """Draw, run every way, judge it."""
    sample = task.source.draw(task.frames, task.seed)
    bench = Bench.of(sample, task.config, task.seed)
    matches = camera_blocks(sample.rig, bench.table, task.config)
    numbers: dict[str, dict[str, Numbers | None]] = {name: {} for name in sample.references}
    runs = list(run_all(bench, trf=task.trf))
    medians_px = {
        row: {} if poses is None else reprojection_px(matches, poses) for row, poses, _ in runs
    }
    base, seconds = medians_px[STAGE1], {row: took for row, _, took in runs}
    for row, poses, _ in runs:
        medians = medians_px[row]
        for name, reference in sample.references.items():
            found = None if poses is None else judged(sample.rig, poses, reference, medians, base)
            numbers[name][row] = found
    return Drawn(numbers, seconds)


def reprojection_px(matches: Mapping[str, CameraBlock], poses: Transforms) -> dict[str, float]:
    """Per camera the median reprojection error of its preprocessed correspondences."""
    return {name: float(np.median(m.errors_px(poses[name])[0])) for name, m in matches.items()}


def judged(
    rig: Rig,
    poses: Transforms,
    reference: Rig,
    medians_px: Mapping[str, float],
    stage1_px: Mapping[str, float],
) -> Numbers:
    """The paper's metrics, without signs, of poses against a reference.

    Args:
        rig: the order of the cameras: of neighbours in it the relative pose is judged.
        poses: T_camera_lidar per camera.
        reference: to judge by.
        medians_px: median reprojection error per camera.
        stage1_px: the same of Stage 1; empty if there is none.
    """
    errors = evaluate(rig.moved_to(poses), reference)
    found = {name: _without_signs(error) for name, error in errors.cameras.items()}
    for name, median in medians_px.items():
        found[name][REPROJECTION] = median
        found[name][IMPROVEMENT] = stage1_px.get(name, np.nan) - median
    for a, b in pairwise(rig.cameras):
        found[f"{a}->{b}"] = _without_signs(errors.pairs[f"{a}->{b}"])
    return found


def _without_signs(error: PoseError) -> dict[str, float]:
    return {metric: abs(value) for metric, value in asdict(error).items()}


def _summaries(frames: int, drawn: Sequence[Drawn]) -> Iterator[Block]:
    for reference in drawn[0].numbers:
        rows = {
            row: _row([d.numbers[reference][row] for d in drawn], [d.seconds[row] for d in drawn])
            for row in drawn[0].numbers[reference]
        }
        yield Block(frames, reference, len(drawn), rows)


def _row(numbers: Sequence[Numbers | None], seconds: Sequence[float]) -> Row:
    good = [n for n in numbers if n is not None]
    summary = {
        name: {m: interval([n[name][m] for n in good]) for m in metrics}
        for name, metrics in (good[0].items() if good else ())
    }
    return Row(summary, len(numbers) - len(good), float(np.median(seconds)))


def interval(values: Sequence[float]) -> Interval:
    """Median, 5 % and 95 % quantile of the values that are numbers; NaN without any."""
    known = [value for value in values if not np.isnan(value)]
    if not known:
        return Interval(np.nan, np.nan, np.nan)
    low, median, high = np.quantile(known, QUANTILES)
    return Interval(float(low), float(median), float(high))
