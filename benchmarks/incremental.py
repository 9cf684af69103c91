"""Time and memory of an update, against plain iSAM2 and against solving the batch again.

    python benchmarks/incremental.py [--frames 20000]

2 cameras, 500 correspondences each, 10 % outliers, all in one run. Plain iSAM2 has a block factor
per camera and frame and never lets one go; it does one pass per frame, ours does two.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
from events import camera

from calibgraph import IncrementalCalibrator, MatcherErrors, Rig, perturb, solve
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences, concatenate
from calibgraph.simulation.correspondences import simulate_drive
from calibgraph.solver.camera_block import camera_blocks
from calibgraph.solver.factor_graph import pose_key, prior_graph, to_values
from calibgraph.solver.residual_scale import CAUCHY_SCALE_SIGMAS
from factors import block_factor

RIG = Rig(
    cameras={"left": camera((0.3, 0.1, -0.1), 0), "right": camera((0.3, -0.4, -0.1), 0)},
)
GUESS = perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=0)
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
POOL = 400
EARLY, SAMPLE = 100, 100  # updates around frame 100, and at the end, whose median is taken
PLAIN_AT = (100, 500, 2000)


def frames(count: int) -> Iterator[Correspondences]:
    """A drive whose frames come from a pool of different ones, over and over."""
    pool = list(simulate_drive(lambda frame: RIG, frames=POOL, matches=500, errors=ERRORS))
    for number in range(count):
        table = pool[number % POOL]
        yield replace(table, frame=np.full(len(table), number))


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def ours(count: int) -> dict[int, float]:
    """Seconds of the updates around some frames, by their number; prints as it goes."""
    tracker = IncrementalCalibrator(GUESS)
    seconds, memory = [], {}
    for number, table in enumerate(frames(count)):
        start = time.perf_counter()
        tracker.update(table)
        seconds.append(time.perf_counter() - start)
        if number + 1 in (1000, count) or (number + 1) % 5000 == 0:
            memory[number + 1] = resident_mb()
    early = float(np.median(seconds[EARLY - SAMPLE // 2 : EARLY + SAMPLE // 2]))
    late = float(np.median(seconds[-SAMPLE:]))
    print(f"ours: {1e3 * early:.2f} ms an update at frame {EARLY}, {1e3 * late:.2f} ms at {count}:")
    print(f"  ratio {late / early:.2f}; {1 / np.mean(seconds):.0f} updates a second over the run;")
    worst = f"99 % {1e3 * np.quantile(seconds, 0.99):.1f} ms, worst {1e3 * max(seconds):.0f} ms"
    print(f"  {worst}; resident MB at frame: { ({k: round(v, 1) for k, v in memory.items()}) }")
    at = {n: float(np.median(seconds[n - 50 : n + 50])) for n in PLAIN_AT if n + 50 <= count}
    return at


def plain_isam2(count: int) -> dict[int, float]:
    """Median seconds of an update around some frames, with no frame ever let go."""
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(1e-7)
    parameters.relinearizeSkip = 1
    isam = gtsam.ISAM2(parameters)
    names = list(RIG.cameras)
    isam.update(
        prior_graph(names, RIG.T_camera_lidar, weight=1.0), to_values(names, RIG.T_camera_lidar)
    )
    seconds = []
    for table in frames(count):
        matches = camera_blocks(RIG, table, Config())
        start = time.perf_counter()
        graph = gtsam.NonlinearFactorGraph()
        for name, m in matches.items():
            graph.add(block_factor(pose_key(names, name), replace(m.block, scale=_SCALE)))
        isam.update(graph, gtsam.Values())
        isam.calculateBestEstimate()
        seconds.append(time.perf_counter() - start)
    return {n: float(np.median(seconds[n - 10 : n])) for n in PLAIN_AT if n <= count}


_SCALE = CAUCHY_SCALE_SIGMAS


def batch(count: int) -> float:
    """Seconds of a batch solve over so many frames."""
    table = concatenate(list(frames(count)))
    solve(GUESS, table)
    start = time.perf_counter()
    solve(GUESS, table)
    return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=20_000)
    count = parser.parse_args().frames
    mine = ours(count)
    plain = plain_isam2(min(count, PLAIN_AT[-1]))
    print("frame   ours ms   plain iSAM2 ms (ratio)   batch again ms (ratio)")
    for number, seconds in mine.items():
        again = batch(number) if number < PLAIN_AT[-1] else np.nan
        print(
            f"{number:5d} {1e3 * seconds:9.2f} {1e3 * plain[number]:12.1f} "
            f"({plain[number] / seconds:.1f})      {1e3 * again:12.0f} ({again / seconds:.0f})"
        )


if __name__ == "__main__":
    main()
