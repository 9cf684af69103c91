"""Time and memory of an update while driving.

    python -m benchmarks.speed.incremental [--frames 20000]

2 cameras, 500 correspondences each, 10 % outliers, all in one run.
"""

import gc
import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.tables import Table, parser_of, publish
from calibgraph import Correspondences, IncrementalCalibrator, MatcherErrors, Rig, perturb
from calibgraph.model.findings import MatcherFindings
from calibgraph.tracking import warm_up_tracker
from tests.draws.drives import simulate_drive
from tools.scenes.drives import camera

RIG = Rig(cameras={"left": camera((0.3, 0.1, -0.1)), "right": camera((0.3, -0.4, -0.1))})
GUESS = perturb(RIG, rotation_deg=1.0, translation_m=0.1, seed=0)
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.5, outlier_share=0.1)
POOL = 400
PLACES, AT_PLACE = 24, 12  # places along a circuit, and frames at each before the next
STATED = MatcherFindings(
    systematic_rotation_rad=0.0005,
    systematic_translation_m=0.005,
    elevation_rad=0.001,
    scan_motion_m=0.01,
    place_rotation_rad=0.001,
    place_translation_m=0.01,
    place_variance=0.5,
)
EARLY, SAMPLE = 100, 100  # medians are of so many updates, around this frame and at the end


def frames(count: int) -> Iterator[Correspondences]:
    """A drive that repeats a pool of different frames, not to the last bit: as others."""
    pool = list(simulate_drive(lambda frame: RIG, frames=POOL, matches=500, errors=ERRORS))
    for number in range(count):
        table = pool[number % POOL]
        pixels_px = table.pixels_px + 1e-6 * (number // POOL)
        yield replace(table, frame=np.full(len(table), number), pixels_px=pixels_px)


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def measure(count: int) -> Table:
    """Seconds of the updates over the run, and memory."""
    warm_up_tracker()
    tracker = IncrementalCalibrator(GUESS)
    seconds, memory = [], {}
    gc.freeze()  # as the command does
    for number, table in enumerate(frames(count)):
        start = time.perf_counter()
        tracker.update(table)
        seconds.append(time.perf_counter() - start)
        if number + 1 in (1000, count) or (number + 1) % 5000 == 0:
            memory[number + 1] = resident_mb()
    early = float(np.median(seconds[EARLY - SAMPLE // 2 : EARLY + SAMPLE // 2]))
    late = float(np.median(seconds[-SAMPLE:]))
    start = int(np.argmax(seconds[:EARLY]))
    rows = [
        (f"median at frame {EARLY} [ms]", f"{1e3 * early:.2f}"),
        (f"median at frame {count} [ms]", f"{1e3 * late:.2f}"),
        ("ratio of the medians", f"{late / early:.2f}"),
        ("mean rate [1/s]", f"{1 / np.mean(seconds):.0f}"),
        ("99 % quantile [ms]", f"{1e3 * np.quantile(seconds, 0.99):.1f}"),
        (f"longest of the first {EARLY} [ms]", f"{1e3 * seconds[start]:.0f}"),
        ("its frame", str(start)),
        ("longest of the others [ms]", f"{1e3 * max(seconds[EARLY:]):.0f}"),
        *((f"resident memory at frame {at} [MB]", f"{mb:.1f}") for at, mb in memory.items()),
    ]
    return Table("Updates", ("", "value"), tuple(rows))


def measure_load(count: int, places: int) -> tuple[str, ...]:
    """Processor time of the updates along some places, as a row."""
    tracker, seconds = IncrementalCalibrator(GUESS), []
    for number, table in enumerate(frames(count)):
        stated = table.with_findings(STATED) if places > 1 else table
        start = time.process_time()
        tracker.update(stated, place=number // AT_PLACE % places)
        seconds.append(time.process_time() - start)
    late = np.array(seconds[EARLY:])
    median, most = float(np.median(late)), float(late.max())
    numbers = 1e3 * median, 1e3 * float(np.quantile(late, 0.95)), 1e3 * most, most / median
    return str(places), *(f"{number:.1f}" for number in numbers)


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("--frames", type=int, default=20_000, help="at least 150")
    options = parser.parse_args()
    of_load = ("places", "median [ms]", "95 % [ms]", "longest [ms]", "longest / median")
    load = tuple(measure_load(min(options.frames, 600), places) for places in (1, PLACES))
    publish([measure(options.frames), Table("Processor time of updates", of_load, load)])


if __name__ == "__main__":
    main()
