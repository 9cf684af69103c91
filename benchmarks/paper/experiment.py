"""The paper's experiment over many draws: each method's errors as medians with 90 % intervals."""

import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from multiprocessing import get_context

import numpy as np

from benchmarks.paper.draws import METHODS, TRF_TERMS, Source, run_methods
from calibgraph.errors import CorrespondenceError
from calibgraph.model.config import Config
from calibgraph.model.metrics import evaluate
from calibgraph.solver.matches import camera_blocks

Numbers = dict[str, dict[str, float]]
"""Per camera, or per pair ``A->B`` of neighbours: metrics by name, without signs."""
Interval = tuple[float, float, float]
"""The 5 % quantile over draws, the median, the 95 % quantile."""
Result = dict[str, tuple[Numbers | None, float]]
"""Of a draw, per row its errors, None if it failed, and its seconds."""

QUANTILES = (0.05, 0.5, 0.95)
REPROJECTION = "reprojection_px"


@dataclass(frozen=True)
class Row:
    """One method over all draws of one number of frames.

    Attributes:
        numbers: per camera or pair, and metric.
        failed: number of draws in which it failed; they are not in the intervals.
        seconds: median time of a draw.
    """

    numbers: dict[str, dict[str, Interval]]
    failed: int
    seconds: float


Report = dict[int, dict[str, Row]]
"""Per number of frames the rows."""


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

    Arguments are the options of the command; the same seed gives the same numbers.

    Raises:
        ValueError: if there is no draw, no frame or no process.
    """
    if draws < 1 or jobs < 1 or not frames or min(frames) < 1:
        raise ValueError(f"nothing to do: {draws} draws of {list(frames)} frames in {jobs} jobs")
    sizes = [*dict.fromkeys(source.frame_count(n) for n in frames)]
    states = {(n, k): np.random.SeedSequence([seed, n, k]) for n in sizes for k in range(draws)}
    tasks = [(n, int(state.generate_state(1)[0] >> 1)) for (n, _), state in states.items()]
    run, found = partial(run_draw, source, config=config, trf=trf), list[Result]()
    with ProcessPoolExecutor(min(jobs, len(tasks)), get_context("spawn")) as pool:
        for result in pool.map(run, tasks) if jobs > 1 else map(run, tasks):
            found.append(result)
            print(f"draws: {len(found)} of {len(tasks)}", file=sys.stderr)
    return {n: _summarize(found[k * draws : (k + 1) * draws]) for k, n in enumerate(sizes)}


def run_draw(source: Source, task: tuple[int, int], *, config: Config, trf: bool) -> Result:
    """Draw, run every method, compare it with the reference by the paper's metrics."""
    try:
        draw = source.draw(*task, config)
    except CorrespondenceError:
        return {row: (None, 0.0) for row in METHODS if trf or row not in TRF_TERMS}
    blocks = camera_blocks(draw.rig, draw.kept, config)
    found: Result = {}
    pairs = {f"{a}->{b}" for a, b in pairwise(draw.rig.cameras)}
    for row, T, seconds in run_methods(draw, trf=trf):
        found[row] = None, seconds
        if T is None:
            continue
        errors = evaluate(draw.rig.moved_to(T), draw.reference)
        kept = {n: e for n, e in errors.pairs.items() if n in pairs}
        metrics = {name: {metric: abs(value) for metric, value in asdict(error).items()}
                   for name, error in {**errors.cameras, **kept}.items()}  # fmt: skip
        for name, block in blocks.items():
            residuals, _ = block.block.residuals(T[name][None])
            metrics[name][REPROJECTION] = float(np.median(np.hypot(*residuals.T)))
        found[row] = metrics, seconds
    return found


def _summarize(results: Sequence[Result]) -> dict[str, Row]:
    rows = {}
    for row in results[0]:
        solved = [numbers for one in results if (numbers := one[row][0]) is not None]
        summary = {
            name: {m: interval([n[name][m] for n in solved]) for m in metrics}
            for name, metrics in (solved[0].items() if solved else ())
        }
        seconds = float(np.median([one[row][1] for one in results]))
        rows[row] = Row(summary, len(results) - len(solved), seconds)
    return rows


def interval(values: Sequence[float]) -> Interval:
    """Median, 5 % and 95 % quantile of the values that are not NaN; NaN without any."""
    known = [value for value in values if not np.isnan(value)]
    low, median, high = np.quantile(known, QUANTILES) if known else [np.nan] * 3
    return float(low), float(median), float(high)
