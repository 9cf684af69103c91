"""``solve`` over a folder of files: the driver of the two passes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.fleet.sharded.block import ShardedBlock
from calibgraph.fleet.sharded.shard import Inventory
from calibgraph.fleet.sharded.steps import (
    blocks_of,
    count_repeats_once,
    stage1,
    total_counts,
    weigh_frames,
)
from calibgraph.fleet.sharded.workers import ENGINES, Engine, Workers, start_workers
from calibgraph.model.calibration import Calibration
from calibgraph.model.config import TERMS, Config, Terms
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.model.rig import Rig
from calibgraph.pipeline import solve, to_calibration
from calibgraph.progress import Progress, Stopwatch, no_progress
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.error_model import weigh_errors
from calibgraph.solver.joint import count_correspondences, solve_joint
from calibgraph.solver.objective import USING_CORRESPONDENCES, Objective
from calibgraph.solver.preprocess import Preprocessed
from calibgraph.solver.repeats import PLACES, lists_of_frames
from calibgraph.solver.solution import Solution
from calibgraph.solver.stage1 import Stage1, T_hat
from calibgraph.solver.start import best_start, require_determined
from calibgraph.trust.assess import assess
from calibgraph.trust.evidence import Evidence

Array = NDArray[np.float64]

_CHECKED_ROWS = 200_000
"""Correspondences that the checks of the verdict are made of: of whole frames, evenly chosen."""


def table_files(table: Path) -> list[Path]:
    """The files of a table: itself, or the Parquet files of a folder, by name.

    Raises:
        FileError: if there is none.
    """
    if not table.is_dir():
        return [table]
    paths = sorted(table.rglob("*.parquet"))
    if not paths:
        raise FileError(table, "holds no .parquet file; write the correspondences into some")
    return paths


def solve_table(
    rig: Rig,
    table: Path,
    config: Config,
    terms: Terms,
    engine: str | None = None,
    *,
    progress: Progress | None = None,
) -> Calibration:
    """``solve`` of a file, :func:`solve_sharded` of a folder; arguments as of these.

    Raises:
        ValueError: if the engine is unknown, or one is given for a file.
    """
    if engine not in (None, *ENGINES):
        raise ValueError(f"unknown engine {engine!r}; known are {', '.join(ENGINES)}")
    if table.is_dir():
        chosen: Engine = engine or "processes"
        return solve_sharded(rig, table, config, terms, engine=chosen, progress=progress)
    if engine is not None:
        raise ValueError(f"{table} is one file, which needs no --engine; give a folder of files")
    return solve(rig, table, config, terms)


def solve_sharded(
    rig: Rig,
    folder: Path | str,
    config: Config | None = None,
    terms: Terms = "full",
    *,
    engine: Engine = "processes",
    workers: int | None = None,
    progress: Progress | None = None,
) -> Calibration:
    """As :func:`calibgraph.solve`, of a table in many files that no memory needs to hold at once.

    Every file stays with one worker; what travels are sums, order statistics and samples. Poses,
    scales, weights, gate, counts and covariance are those of ``solve`` but for the order of
    summation, which is that of the files for any number of workers. The checks of the verdict, and
    the correspondences of the result, are of an even selection of frames, solved as a table.

    Args:
        rig: cameras with their initial guess, and independently known relative poses.
        folder: of Parquet files; all rows of a frame are in one of them.
        config: settings; the preset ``auto`` if None.
        terms: as of ``solve``.
        engine: ``local``, ``processes`` or ``ray``.
        workers: how many; one per core if None.
        progress: called as the work goes on.

    Raises:
        FileError, CorrespondenceError, ValueError: as of ``solve``.
        CalibrationError: if the engine is not installed, or a worker died.
    """
    if terms not in TERMS:
        raise ValueError(f"unknown terms {terms!r}; known are {', '.join(TERMS)}")
    config, report = config or Config(), progress or no_progress
    report("reading", 0, 1)
    paths = [str(path) for path in table_files(Path(folder))]
    with start_workers(rig, paths, config, engine, workers) as held:
        solution, sample = solve_with(rig, held, config, terms, report)
        report("checks", 0, 1)
        return _judge(solution, sample, config, terms)


# fmt: off
def solve_with(
    rig: Rig, workers: Workers, config: Config, terms: Terms, report: Progress
) -> tuple[Solution, Correspondences]:
    """The two passes, as ``solver.joint.solve_joint``."""
    watch = Stopwatch()
    with watch("preprocess"):
        files = count_repeats_once(workers, workers.call("load"))
        counts = total_counts(files)
        held = require_determined(rig, counts)
        sample = sample_frames(workers, files)
    with watch("stage1"):
        report("stage1", 0, 1)
        pairwise = stage1(workers, files, rig, config)
        blocks = blocks_of(workers, files, rig, config)
        start = best_start(rig, _as_blocks(blocks), pairwise, config, terms)
    with watch("weights"):
        report("weights", 0, 1)
        weighed, start, outliers = _weigh(blocks, start, pairwise, config, terms)
    objective = Objective(rig, _as_blocks(weighed), T_hat(pairwise), config, terms)
    with watch("pass1"):
        report("pass1", 0, 1)
        rough, scales = objective.minimize_with_scale(start)
    with watch("pass2"):
        report("pass2", 0, 1)
        inliers = objective.without_outliers(rough, scales)
        optimum = inliers.minimize(rough, scales)
        errors, optimum = weigh_errors(inliers, optimum, scales, sample.metadata, held)
    repeated = {name: sum(file.repeated[name] for file in files) for name in rig.cameras}
    kept = Preprocessed(sample, counts, repeated)
    found = count_correspondences(kept, objective, inliers, pairwise, outliers)
    solution = Solution(rig, sample, objective, inliers, scales, optimum, found, watch.seconds,
                        held=held, errors=errors)
    return solution, sample
# fmt: on


def _weigh(
    blocks: dict[str, ShardedBlock],
    start: dict[str, Array],
    pairwise: Stage1,
    config: Config,
    terms: Terms,
) -> tuple[dict[str, ShardedBlock], dict[str, Array], dict[str, int]]:
    """As ``solver.frame_weights.weigh_all_frames``: blocks, starts, outlier frames."""
    learnt = config.learnt_weights and config.stage1 == "pnp" and terms in USING_CORRESPONDENCES
    if not learnt:
        return blocks, start, {}
    weighed, starts, outliers = {}, dict(start), {}
    for name, block in blocks.items():
        by_frame = pairwise[name].by_frame if name in pairwise else {}
        weighed[name], starts[name], outliers[name] = weigh_frames(block, start[name], by_frame)
    return weighed, starts, outliers


def _as_blocks(blocks: dict[str, ShardedBlock]) -> dict[str, CameraBlock]:
    """For the solver, which asks of both kinds of blocks the same."""
    return cast(dict[str, CameraBlock], blocks)


def sample_frames(workers: Workers, files: Sequence[Inventory]) -> Correspondences:
    """The rows of every k-th frame, so that there are about _CHECKED_ROWS at most."""
    rows = sum(int(frames.counts.sum()) for file in files for frames in file.cameras.values())
    step, each, first = max(1, -(-rows // _CHECKED_ROWS)), list[tuple[Any]](), 0
    for file in files:
        numbers = np.unique(np.concatenate([f.numbers for f in file.cameras.values()]))
        each.append((numbers[-first % step :: step],))
        first += len(numbers)
    parts = [part for part in workers.call("frame_rows", each=each) if len(part)]
    sample, places = concatenate(parts), places_of_files(files)
    metadata = {**sample.metadata, PLACES: places} if places else sample.metadata
    return replace(sample, metadata=metadata)


def places_of_files(files: Sequence[Inventory]) -> list[list[int]]:
    """The frames of each place that some file states; what several state alike is one place."""
    stated = [place for file in files for place in lists_of_frames(file.metadata, PLACES)]
    return [list(place) for place in dict.fromkeys(map(tuple, stated))]


def _judge(
    solution: Solution, sample: Correspondences, config: Config, terms: Terms
) -> Calibration:
    """The result: estimates and error bars of all files, the verdict of the selection."""
    whole = Evidence(solution, solution.rig)
    selection = Evidence(solve_joint(solution.rig, sample, config, terms), solution.rig)
    checked = to_calibration(selection, assess(selection))
    return replace(
        checked,
        rig=solution.solved_rig,
        covariance={name: whole.covariance_of(name) for name in whole.cameras},
        joint_covariance=whole.joint_covariance,
        residuals=whole.residuals,
        counts={name: dict(counts) for name, counts in solution.counts.items()},
        timings_s=dict(solution.timings_s),
        stage1_T_camera_lidar=solution.T_hat,
        prior_share=whole.prior_shares,
        error_sources=whole.error_sources,
    )
