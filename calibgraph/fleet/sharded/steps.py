"""The steps before the objective, over many files: repeats, Stage 1, weights of frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import CorrespondenceError
from calibgraph.fleet.sharded.block import ShardedBlock, even_places, measure
from calibgraph.fleet.sharded.shard import CameraFrames, Inventory
from calibgraph.fleet.sharded.workers import Workers
from calibgraph.model.config import Config
from calibgraph.model.correspondences import concatenate
from calibgraph.model.rig import Rig
from calibgraph.solver.camera_block import MIN_MATCHES
from calibgraph.solver.frame_fits import FrameFits, about_common_extrinsic
from calibgraph.solver.frame_weights import (
    MIN_FRAMES_TO_WEIGH,
    count_groups,
    densest_start,
    falling_logarithms,
    find_consensus,
)
from calibgraph.solver.pnp import pose_near_guess, ransac_pnp
from calibgraph.solver.stage1 import COMMON_SAMPLE, CameraStage1, Stage1, aggregate_frames

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]


def count_repeats_once(workers: Workers, files: Sequence[Inventory]) -> list[Inventory]:
    """The inventories without frames that repeat a frame of an earlier file, which drop them.

    Raises:
        CorrespondenceError: if a frame is in two files, with different content.
    """
    kept = [replace(file, cameras=dict(file.cameras), counts=dict(file.counts),
                    repeated=dict(file.repeated)) for file in files]  # fmt: skip
    for name in files[0].cameras:
        known, numbers = set[tuple[int, int]](), dict[int, int]()
        drops: list[tuple[Numbers]] = []
        for place, file in enumerate(kept):
            frames = file.cameras[name]
            keys = [*zip(frames.counts.tolist(), frames.contents.tolist(), strict=True)]
            new = np.array([key not in known for key in keys], dtype=np.bool_)
            _require_whole(workers, name, numbers, frames.numbers[new], place)
            known.update(keys)
            drops.append((frames.numbers[~new],))
            _leave_out(file, name, frames, new)
        if any(len(dropped) for (dropped,) in drops):
            workers.call("drop", name, each=drops)
    return kept


def _require_whole(
    workers: Workers, camera: str, numbers: dict[int, int], new: Numbers, place: int
) -> None:
    """Check that no frame has rows in two files: its error and its grid belong together."""
    for number in new.tolist():
        other = numbers.setdefault(number, place)
        if other != place:
            raise CorrespondenceError(
                f"frame {number} of camera {camera!r} has rows in {workers.paths[other]} and in "
                f"{workers.paths[place]}; write all rows of a frame into one file"
            )


def _leave_out(file: Inventory, name: str, frames: CameraFrames, new: NDArray[np.bool_]) -> None:
    """Take the frames that are not new out of an inventory."""
    left = int(frames.counts[new].sum())
    file.cameras[name] = replace(
        frames, numbers=frames.numbers[new], counts=frames.counts[new],
        contents=frames.contents[new],
    )  # fmt: skip
    file.counts[name] = {**file.counts[name], "capped": left}
    file.repeated[name] += int(np.count_nonzero(~new))


def total_counts(files: Sequence[Inventory]) -> dict[str, dict[str, int]]:
    """Per camera, the correspondences left after each filter, of all files."""
    return {
        name: {key: sum(file.counts[name][key] for file in files) for key in counts}
        for name, counts in files[0].counts.items()
    }


def stage1(workers: Workers, files: Sequence[Inventory], rig: Rig, config: Config) -> Stage1:
    """As ``solver.stage1.estimate_stage1``: the same selection, the same frames."""
    seen = [name for name in rig.cameras if any(len(f.cameras[name].numbers) for f in files)]
    if config.stage1 == "rig":
        return {name: CameraStage1(rig.cameras[name].T_camera_lidar) for name in seen}
    return {name: _stage1_of(name, workers, files, rig, config) for name in seen}


def _stage1_of(
    name: str, workers: Workers, files: Sequence[Inventory], rig: Rig, config: Config
) -> CameraStage1:
    counts = [int(file.cameras[name].counts.sum()) for file in files]
    places = even_places(counts, COMMON_SAMPLE)
    rows = workers.call("rows_at", name, each=[(some,) for some in places])
    sample = concatenate([part for part in rows if len(part)])
    start = pose_near_guess(rig.cameras[name], sample, config)
    if not all(workers.call("are_all_found", name, start)):
        start = ransac_pnp(rig.cameras[name], sample, config)
    poses, numbers = zip(*workers.call("stage1", name, start), strict=True)
    frames = sum(len(file.cameras[name].numbers) for file in files)
    return aggregate_frames(np.concatenate(poses), np.concatenate(numbers), frames, config)


def blocks_of(
    workers: Workers, files: Sequence[Inventory], rig: Rig, config: Config
) -> dict[str, ShardedBlock]:
    """The blocks of the cameras that have enough correspondences.

    Raises:
        CorrespondenceError: if some files have the pixels' information and others do not.
    """
    blocks = {}
    for name in rig.cameras:
        parts = [file.cameras[name] for file in files]
        informed = {part.informed for part in parts if part.informed is not None}
        if len(informed) > 1:
            raise CorrespondenceError(
                f"camera {name!r}: some files have the columns of information and others do not; "
                "write them into all",
                camera=name,
            )
        block = ShardedBlock(
            workers, name, "all", tuple(part.numbers for part in parts),
            tuple(part.counts for part in parts), True in informed or config.confidence_weights,
        )  # fmt: skip
        if len(block) >= MIN_MATCHES:
            blocks[name] = block
    workers.call("build", list(blocks))
    return blocks


def weigh_frames(
    block: ShardedBlock, T_camera_lidar: Array, by_frame: Mapping[int, Array]
) -> tuple[ShardedBlock, Array, int]:
    """As ``solver.frame_weights.weigh_frames``.

    Returns:
        The block without outlier frames, weighted; (4, 4) where frames are densest; how many
        frames are outliers.
    """
    if block.frames < MIN_FRAMES_TO_WEIGH:
        return block, T_camera_lidar, 0
    workers, camera = block.workers, block.camera
    starts = [(np.array([by_frame.get(number, T_camera_lidar) for number in numbers.tolist()])
               .reshape(-1, 4, 4),) for numbers in block.frame_parts]  # fmt: skip
    parts: list[FrameFits] = workers.call("fit_frames", camera, each=starts)
    ends = np.cumsum([len(numbers) for numbers in block.frame_parts])[:-1]
    frames = _common_spreads(parts)
    each_spread = [(values,) for values in np.split(frames.spreads, ends)]
    workers.call("scale_sizes", camera, each=each_spread)
    middles, falling, median = _confidence_curve(block)
    # The start is a choice by the residuals of all correspondences, not yet weighted.
    start = densest_start(block, frames, T_camera_lidar)
    T_consensus, weights = find_consensus(frames, start)
    each = [(own, middles, falling, median) for own in np.split(weights, ends)]
    left = workers.call("weigh", camera, each=each)
    outliers = int(np.count_nonzero(weights == 0))
    return replace(block.with_frames("all", left), whitened=True), T_consensus, outliers


def _common_spreads(parts: Sequence[FrameFits]) -> FrameFits:
    """The fits of all frames, with their spreads about the common extrinsic."""
    names = ("T_camera_lidar", "counts", "spreads", "spreads_px", "hessians", "sizes")
    joined = FrameFits(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})
    return replace(joined, spreads=about_common_extrinsic(joined.spreads, joined.counts))


def _confidence_curve(block: ShardedBlock) -> tuple[Array, Array, float]:
    """Confidences, logarithms of standard deviations there, and the median of all of these.

    Empty where ``solver.frame_weights.confidence_sigmas`` gives all the same.
    """
    workers, camera, none = block.workers, block.camera, np.empty(0)
    values = measure(workers, "confident", camera)
    groups = count_groups(len(values))
    if groups == 1 or values.at(0) == values.at(len(values) - 1):
        return none, none, 1.0
    sizes = _group_sizes(len(values), groups)
    ends = np.cumsum(sizes)[:-1]
    bounds = np.array([values.at(int(end) - 1) for end in ends])
    before = [values.count_up_to(np.nextafter(bound, 0.0)) for bound in bounds]
    ties = np.array(workers.call("ties", camera, bounds)).reshape(len(workers.paths), -1)
    first = np.cumsum(ties, axis=0) - ties  # equal ones in earlier files come first
    inside = (ends - before - first).clip(0, ties)
    workers.call("group", camera, bounds, each=[(own,) for own in inside])
    spreads = [measure(workers, "size_of_group", camera, group).robust_spread
               for group in range(groups)]  # fmt: skip
    middles = np.array([measure(workers, "confidence_of_group", camera, group).median
                        for group in range(groups)])  # fmt: skip
    falling = falling_logarithms(np.array(spreads), sizes)
    return middles, falling, measure(workers, "learnt", camera, middles, falling).median


def _group_sizes(values: int, groups: int) -> Numbers:
    """As of ``numpy.array_split``."""
    return np.array([values // groups + (group < values % groups) for group in range(groups)])
