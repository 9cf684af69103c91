"""Time and memory from 10^3 to 10^8 correspondences: tables streamed from disk, and one pass.

    python benchmarks/scaling.py [--rows 1e3 ... 1e8] [--kept 1e3 ... 1e7] [--folder DIR] [--json F]

First table: Parquet tables of a dense matcher (2 cameras, frames of up to 50,000 matches each,
float32) are written to --folder and solved there, each in a process of its own, whose peak resident
memory is measured; 10^8 rows take 3.6 GB on disk until they are solved. Beside it, up to
--whole-up-to rows, the same with the table loaded whole. Second table: one pass (H, b and c) over
correspondences in memory, beside the time in which memory gives their bytes (40 each).
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import parquet

from calibgraph import MatcherErrors, Rig, load_correspondences, perturb, simulate_correspondences
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.pipeline import solve
from calibgraph.simulation.rigs import rig_of
from factors import ProjectionBlock

Array = NDArray[Any]
Row = dict[str, Any]

RIG = "kitti"
MATCHES = 50_000  # of one camera in one frame
FRAMES = 5  # at least
DRAWN_FRAMES = 10  # then they come again, with other noise
ERRORS = MatcherErrors(noise_px=0.7, frame_noise_px=0.3, outlier_share=0.15)
MEMORY_BYTES = 400_000_000  # more than any cache holds
BYTES = 40  # of a correspondence: x y z u v
WARM_UP_ROWS = 1000
TURNS, IN_A_ROW = 12, 4


def main() -> None:
    """Print both tables."""
    options = parsed()
    if options.child is not None:
        print(json.dumps(measured(options.child, whole=options.whole)))
        return
    rows = list(streamed(options)) if options.rows else []
    passes = [one_pass(int(count)) for count in options.kept]
    if passes:
        print_passes(passes)
    if options.json is not None:
        options.json.write_text(json.dumps({"tables": rows, "passes": passes}, indent=1), "utf-8")


def parsed() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    every = [10.0**k for k in range(3, 9)]
    parser.add_argument("--rows", type=float, nargs="*", default=every, help="of the tables")
    parser.add_argument("--kept", type=float, nargs="*", default=every[:-1], help="in memory")
    parser.add_argument("--whole-up-to", type=float, default=1e7, metavar="ROWS")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--json", type=Path, help="write the numbers into this file, too")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--whole", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def streamed(options: argparse.Namespace) -> Iterator[Row]:
    """Write, solve and remove a table of each size; print a line for each."""
    print(
        f"{'rows':>12} {'file MB':>8} {'':9} {'read s':>8} {'rest s':>8} {'peak MB':>8} {'kept':>9}"
    )
    for count in map(int, options.rows):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            path = write_table(count, Path(folder) / "table.parquet")
            file_mb = path.stat().st_size / 1e6
            for whole in (False, True)[: 1 + (count <= options.whole_up_to)]:
                row = {"rows": count, "file_mb": file_mb, **in_a_process(path, whole=whole)}
                how = "loaded" if whole else "streamed"
                print(
                    f"{count:12} {file_mb:8.0f} {how:9} {row['read_s']:8.2f} {row['rest_s']:8.2f} "
                    f"{row['peak_mb']:8.0f} {row['kept']:9}",
                    flush=True,
                )
                yield row


def write_table(count: int, path: Path) -> Path:
    """A table with about so many rows, a row group for each camera and frame."""
    frames = max(FRAMES, round(count / 2 / MATCHES))
    rig, rng = rig_of(RIG), np.random.default_rng(0)
    drawn = simulate_correspondences(
        rig, frames=min(frames, DRAWN_FRAMES), matches=round(count / 2 / frames), errors=ERRORS
    )
    parts = [drawn.of_camera(name) for name in rig.cameras]
    writer = None
    for frame in range(frames):
        for name, part in zip(rig.cameras, parts, strict=True):
            rows = part.select(part.frame == frame % DRAWN_FRAMES)
            again = rng.normal(0.0, 0.5, rows.pixels_px.shape)
            columns = np.column_stack([rows.pixels_px + again, rows.points_lidar_m])
            table = pa.table(
                {
                    "camera": pa.array([name]).dictionary_encode().take(pa.array([0] * len(rows))),
                    "frame": np.full(len(rows), frame),
                    **dict(
                        zip(
                            ("u_px", "v_px", "x_m", "y_m", "z_m"),
                            np.ascontiguousarray(columns.T, dtype=np.float32),
                            strict=True,
                        )
                    ),
                    "confidence": rows.confidence,
                }
            )
            writer = writer or parquet.ParquetWriter(path, table.schema)
            writer.write_table(table)
    assert writer is not None
    writer.close()
    return path


def in_a_process(path: Path, *, whole: bool) -> Row:
    """What :func:`measured` finds in a fresh process."""
    command = [sys.executable, __file__, "--child", str(path), *(["--whole"] if whole else [])]
    found = subprocess.run(command, check=True, capture_output=True, text=True)
    return dict(json.loads(found.stdout))


def measured(path: Path, *, whole: bool) -> Row:
    """Solve a table: seconds to read and preprocess it, and for the rest; peak resident memory."""
    guess = start()
    solve(guess, simulate_correspondences(rig_of(RIG), frames=FRAMES, matches=WARM_UP_ROWS // 10))
    begun = time.perf_counter()
    result = solve(guess, load_correspondences(path) if whole else path)
    seconds = time.perf_counter() - begun
    read_s = seconds - sum(v for k, v in result.timings_s.items() if k != "preprocess")
    return {
        "read_s": read_s,
        "rest_s": seconds - read_s,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "kept": sum(count["capped"] for count in result.counts.values()),
        "verdict": result.verdict.status,
    }


def start() -> Rig:
    """The guess."""
    return perturb(rig_of(RIG), rotation_deg=0.5, translation_m=0.05)


def one_pass(count: int) -> Row:
    """Nanoseconds per correspondence: of a pass, and of reading its bytes; one and all threads."""
    camera = next(iter(rig_of(RIG).cameras.values()))
    block = in_memory(count)
    pose = to_T_lidar_camera(camera.T_camera_lidar)
    memory = np.ones(MEMORY_BYTES // 8)
    threads = numba.config.NUMBA_NUM_THREADS
    row: Row = {"correspondences": count, "threads": threads}
    for name, used in (("one", 1), ("all", threads)):
        numba.set_num_threads(used)
        read, passed = best_of(lambda: _sum_of(memory), lambda: block.sums(pose), count=count)
        read *= count / (memory.nbytes / BYTES)
        row |= {f"read_{name}_ns": read, f"pass_{name}_ns": passed}
    numba.set_num_threads(threads)
    return row


def in_memory(count: int) -> ProjectionBlock:
    """A block of so many correspondences: 100,000 different ones at most."""
    rig = rig_of(RIG)
    name = next(iter(rig.cameras))
    few = simulate_correspondences(
        rig, frames=1, matches=min(count, 100_000), errors=ERRORS
    ).of_camera(name)
    rows = np.arange(count) % len(few)
    return ProjectionBlock(
        rig.cameras[name].lens, few.points_lidar_m[rows], few.pixels_px[rows], scale=4.0
    )


def best_of(*runs: Callable[[], object], count: int) -> list[float]:
    """The least time of each of several things, in turns, in nanoseconds per correspondence.

    Several times in a row each: passes of a solve find in the caches what fits there.
    """
    times = np.full(len(runs), np.inf)
    for index in list(range(len(runs))) * TURNS:  # the first turn compiles
        for _ in range(IN_A_ROW):
            begun = time.perf_counter()
            runs[index]()
            times[index] = min(times[index], time.perf_counter() - begun)
    return [float(t / count * 1e9) for t in times]


@numba.njit(parallel=True, fastmath=True)
def _sum_of(values: Array) -> float:
    total = 0.0
    for index in numba.prange(len(values)):
        total += values[index]
    return total


def print_passes(passes: list[Row]) -> None:
    """The second table."""
    print(f"\n{'':14} | {'one thread':^26} | {'all threads':^26}")
    print(f"{'in memory':>14}" + f" | {'pass ns':>8} {'read ns':>8} {'ratio':>8}" * 2)
    for row in passes:
        line = f"{row['correspondences']:14}"
        for name in ("one", "all"):
            ours, read = row[f"pass_{name}_ns"], row[f"read_{name}_ns"]
            line += f" | {ours:8.2f} {read:8.2f} {ours / read:8.1f}"
        print(line)


if __name__ == "__main__":
    main()
