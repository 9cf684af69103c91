"""One solve over a table in many files, against the same solve on one machine.

    python -m benchmarks.fleet.sharded [--rows 1e6 1e7] [--files 64] [--engines one ray]

Two cameras, 10,000 matches of each in a frame, as float32; 10^8 rows take 3 GB. Each solve is
a process of its own (`one`: the files read one after the other into `solve`'s own path, in one
process). Seconds of the stages; how long a call to all workers takes that computes nothing, and one
that sums over all correspondences (LM asks for two or three an iteration, of each camera); the most
memory of the driver and of a worker; the largest difference of a pose from that of `one` [rad, m]
and the largest of the covariance over its standard deviations.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from pyarrow import parquet

from benchmarks.speed.scaling import ERRORS, RIG, row_group
from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph import perturb, simulate_correspondences
from calibgraph.fleet.sharded.solve import solve_with, table_files
from calibgraph.fleet.sharded.workers import start_workers
from calibgraph.io.correspondence_tables import parts_of_file
from calibgraph.model.config import Config
from calibgraph.model.geometry import to_T_lidar_camera, twist_between
from calibgraph.progress import no_progress
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.preprocess import preprocess_parts
from calibgraph.solver.solution import Solution
from calibgraph.trust.evidence import Evidence

MATCHES = 10_000
CALLS = 20
HEAD = (
    "rows", "kept", "engine", "read s", "stage1 s", "weights s", "pass1 s", "pass2 s",
    "covariance s", "empty call ms", "sums ms", "driver MB", "worker MB", "pose", "covariance",
)  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=float, nargs="+", default=[1e6, 1e7])
    parser.add_argument("--files", type=int, default=64)
    parser.add_argument("--engines", nargs="+", default=["one", "processes", "ray"])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--child")
    add_record_option(parser)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(measure(options.folder, options.child)))
        return
    rows = []
    for count in options.rows:
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            write_files(Path(folder), int(count), options.files)
            found = {e: in_process(Path(folder), e) for e in options.engines}
        rows += [cells(int(count), e, one, found[options.engines[0]]) for e, one in found.items()]
    table = Table("One solve over a table in many files", HEAD, tuple(rows))
    publish("fleet.sharded", [table], record=options.record)


def write_files(folder: Path, rows: int, files: int) -> None:
    """The files: frames of ten that were drawn, each with other noise."""
    rng, rig = np.random.default_rng(0), rig_of(RIG)
    drawn = simulate_correspondences(rig, frames=10, matches=MATCHES, errors=ERRORS)
    of_camera = {name: drawn.of_camera(name) for name in rig.cameras}
    for number, frames in enumerate(np.array_split(np.arange(rows // (2 * MATCHES)), files)):
        writer = None
        for frame in frames.tolist():
            for name, rows_of in of_camera.items():
                some = rows_of.select(rows_of.frame == frame % 10)
                table = row_group(name, frame, some, rng)
                path = folder / f"part{number:03d}.parquet"
                writer = writer or parquet.ParquetWriter(path, table.schema)
                writer.write_table(table)
        if writer is not None:
            writer.close()


def in_process(folder: Path, engine: str) -> dict[str, Any]:
    """Run :func:`measure` in a fresh process."""
    command = [sys.executable, "-m", "benchmarks.fleet.sharded", "--folder", str(folder)]
    done = subprocess.run(
        [*command, "--child", engine], cwd=ROOT, check=True, capture_output=True, text=True
    )
    return dict(json.loads(done.stdout.splitlines()[-1]))


def measure(folder: Path, engine: str) -> dict[str, Any]:
    """Solve the files of a folder."""
    guess = perturb(rig_of(RIG), rotation_deg=0.5, translation_m=0.05)
    files = table_files(folder)
    solve_joint(guess, simulate_correspondences(guess, frames=10, matches=100))  # compiles
    if engine == "one":
        begun, config = time.perf_counter(), Config()
        parts = (part for path in files for part in parts_of_file(path))
        kept = preprocess_parts(guess, parts, config)
        read_s = time.perf_counter() - begun
        found = summary(solve_joint(guess, kept.table, config))
        return found | {"read": read_s, "worker_mb": 0.0, "empty_ms": 0.0, "sums_ms": 0.0}
    with start_workers(guess, [str(path) for path in files], Config(), engine) as workers:  # type: ignore[arg-type]
        solution, _ = solve_with(guess, workers, Config(), "full", no_progress)
        found = summary(solution)
        name = guess.cameras and next(iter(guess.cameras))
        block = solution.inliers.blocks[name].with_scale(solution.scales[name])
        pose = to_T_lidar_camera(solution.T_camera_lidar[name])
        empty_ms = milliseconds(lambda: workers.call("peak_bytes"))
        sums_ms = milliseconds(lambda: block.sums(pose))
        most = max(workers.call("peak_bytes")) / 1e6
    return found | {"worker_mb": most, "empty_ms": empty_ms, "sums_ms": sums_ms}


def milliseconds(run: Any) -> float:
    """The median of some runs."""
    times = []
    for _ in range(CALLS):
        begun = time.perf_counter()
        run()
        times.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(times))


def summary(solution: Solution) -> dict[str, Any]:
    """What is compared, and the seconds of the stages."""
    begun, evidence = time.perf_counter(), Evidence(solution, solution.rig)
    covariance = evidence.joint_covariance
    assert covariance is not None
    seconds = solution.timings_s
    return {
        "T": {name: T.tolist() for name, T in solution.T_camera_lidar.items()},
        "covariance": covariance.tolist(),
        "covariance_s": time.perf_counter() - begun,
        "read": seconds["preprocess"],
        **{stage: seconds[stage] for stage in ("stage1", "weights", "pass1", "pass2")},
        "kept": sum(count["capped"] for count in solution.counts.values()),
        "driver_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def cells(rows: int, engine: str, found: dict[str, Any], one: dict[str, Any]) -> tuple[str, ...]:
    """A line of the table."""
    pose = max(np.abs(twist_between(np.array(found["T"][n]), np.array(one["T"][n]))).max()
               for n in one["T"])  # fmt: skip
    before, after = np.array(one["covariance"]), np.array(found["covariance"])
    sigma = np.sqrt(np.diag(before))
    difference = np.abs((after - before) / np.outer(sigma, sigma)).max()
    stages = ("read", "stage1", "weights", "pass1", "pass2", "covariance_s")
    return (
        f"{rows:.0e}", f"{found['kept']:,}", engine, *(f"{found[stage]:.1f}" for stage in stages),
        f"{found['empty_ms']:.1f}", f"{found['sums_ms']:.1f}", f"{found['driver_mb']:.0f}",
        f"{found['worker_mb']:.0f}", f"{pose:.0e}", f"{difference:.0e}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
