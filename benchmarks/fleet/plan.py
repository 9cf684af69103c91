"""What 10^5 vehicles take: measured constants, and a simulation that is compared with small runs.

python -m benchmarks.fleet.plan FOLDER    # the folder of benchmarks.fleet.engines, after its run
"""

from __future__ import annotations

import argparse
import shutil
import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from benchmarks.fleet.simulation import Plan, simulate
from benchmarks.tables import ROOT, Table, add_record_option, publish
from calibgraph.fleet.rows import read_rows
from calibgraph.fleet.run import run_fleet
from calibgraph.fleet.task import CameraResult, Outcome, Task
from tests.draws.fleets import write_fleet
from tests.fleet.killing import kill_at_random

Seconds = NDArray[np.float64]
JOBS, SLOTS = 100_000, (100, 1_000, 10_000)


def main() -> None:
    """Measure the driver, compare the simulation with runs, and plan."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    add_record_option(parser)
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    driver_s = _driver_seconds(given.folder / "driver")
    drives = _seconds(given.folder / "processes", "drive")
    tables = [
        _constants(given.folder, driver_s, drives),
        _compare(given.folder, driver_s, rng),
        _plan(drives, driver_s, rng),
    ]
    publish("fleet.plan", tables, record=given.record)


def _seconds(out: Path, prefix: str) -> Seconds:
    """Per vehicle of this prefix, the seconds of its job."""
    rows = read_rows(str(out))
    found = dict(zip(rows["vehicle"].to_pylist(), rows["seconds"].to_pylist(), strict=True))
    return np.array([found[name] for name in sorted(found) if name.startswith(prefix)])


class _AtOnce:
    """An engine that answers at once: what is left is the driver's own work."""

    slots = 100

    def submit(self, task: Task) -> Future[Outcome]:
        numbers = tuple(np.random.default_rng(task.job.row).random(36).tolist())
        cameras = tuple(
            CameraResult(f"c{i}", "PASS", False, 0.001, (), numbers[:16], numbers) for i in range(6)
        )
        future: Future[Outcome] = Future()
        future.set_result(
            Outcome(cameras=cameras, versions='{"calibgraph": "0.1.0"}', log="x" * 500)
        )
        return future

    def close(self) -> None:
        """Nothing to release."""


def _driver_seconds(folder: Path, jobs: int = 3000) -> float:
    """Of processor time per job: look at its input, submit, collect, publish rows and a log."""
    shutil.rmtree(folder, ignore_errors=True)
    write_fleet(folder, 1, frames=5, matches=6)
    table = (folder / "car-00000.parquet").name
    columns = {"vehicle": [f"v{i}" for i in range(jobs)], "recording": [table] * jobs,
               "rig": ["nominal.yaml"] * jobs}  # fmt: skip
    csv.write_csv(pa.table(columns), folder / "many.csv")
    start = time.process_time()
    run_fleet(str(folder / "many.csv"), str(folder / "out"), engine=_AtOnce())
    return (time.process_time() - start) / jobs


def _constants(folder: Path, driver_s: float, drives: Seconds) -> Table:
    """What the plan is made of."""
    sample = [path for path in (ROOT / "data" / "sample").rglob("*") if path.is_file()]
    rows = [path for path in (folder / "processes").rglob("*.parquet")]
    count = len(read_rows(str(folder / "processes")))
    tables = _seconds(folder / "processes", "car")
    return Table(
        "Constants, one thread per job",
        ("what", "value"),
        (
            ("a recording of 3 cameras and 2 frames [s, median]", f"{np.median(drives):.1f}"),
            ("a table of 720 correspondences [s, median]", f"{np.median(tables):.3f}"),
            ("the driver per job of 6 cameras [ms]", f"{driver_s * 1e3:.2f}"),
            ("the sample, 6 frames [MB]", f"{sum(p.stat().st_size for p in sample) / 1e6:.1f}"),
            ("the sample [files]", str(len(sample))),
            ("a row in a file [bytes]", f"{sum(p.stat().st_size for p in rows) / count:.0f}"),
        ),
    )


def _compare(folder: Path, driver_s: float, rng: np.random.Generator) -> Table:
    """Simulated and measured wall time of 300 tables: 1 slot, 2 slots, 2 slots with kills."""
    manifest = folder / "in" / "fleet.csv"
    lines = []
    for slots in (1, 2):
        wall, seconds = _run(manifest, folder / f"plan-{slots}", slots)
        plan = Plan(slots, driver_s, start_s=_start_seconds(folder, slots))
        found = simulate(seconds, plan, rng)
        lines.append((f"{slots} at once", wall, found.wall_s, 0, found.retries))
    calm = seconds  # the times of a run without kills
    stop, kills = threading.Event(), [0]
    thread = threading.Thread(target=kill_at_random, args=(stop, kills), daemon=True)
    thread.start()
    wall, _ = _run(manifest, folder / "plan-kills", 2)
    stop.set()  # kills go on to the end of the run, unless there are 50 of them before
    thread.join()
    per_hour = kills[0] / wall * 3600 / 2
    killed = replace(plan, losses_per_hour=per_hour)
    runs = [simulate(calm, killed, rng) for _ in range(20)]
    mean = float(np.mean([run.wall_s for run in runs]))
    retries = float(np.mean([run.retries for run in runs]))
    lines.append((f"2 at once, {kills[0]} kills", wall, mean, kills[0], retries))
    cells = [(name, f"{wall:.1f}", f"{simulated:.1f}", f"{simulated / wall:.2f}", f"{again:.0f}")
             for name, wall, simulated, _, again in lines]  # fmt: skip
    columns = ("run", "measured [s]", "simulated [s]", "ratio", "simulated retries")
    return Table("Simulation against runs of 300 tables", columns, (*cells,))


def _run(manifest: Path, out: Path, slots: int) -> tuple[float, Seconds]:
    """Wall time of a run, and the seconds of its jobs."""
    shutil.rmtree(out, ignore_errors=True)
    start = time.perf_counter()
    run_fleet(str(manifest), str(out), slots=slots)
    return time.perf_counter() - start, _seconds(out, "car")


def _start_seconds(folder: Path, slots: int) -> float:
    """Wall time until the processes of a run are ready: a run of a job per slot, less the jobs."""
    manifest = write_fleet(folder / f"start-{slots}", slots)
    wall, seconds = _run(manifest, folder / f"start-{slots}-out", slots)
    return max(wall - float(seconds.max()), 0.0)


def _plan(drives: Seconds, driver_s: float, rng: np.random.Generator) -> Table:
    """10^5 recordings: as measured, then with losses and stragglers, on more and more slots."""
    seconds = rng.choice(drives, JOBS)
    rows = []
    for slots in SLOTS:
        calm = Plan(slots, driver_s, start_s=30.0)
        rough = replace(calm, losses_per_hour=0.1, straggler_share=0.01, straggler_factor=20.0,
                        timeout_s=600.0)  # fmt: skip
        for name, plan in (("calm", calm), ("losses, stragglers", rough)):
            run = simulate(seconds, plan, rng)
            rows.append((
                f"{slots}, {name}", f"{run.wall_s / 3600:.2f}", f"{100 * run.slot_use:.0f}",
                f"{100 * run.driver_use:.0f}", str(run.retries), str(run.failed),
            ))  # fmt: skip
    columns = ("slots", "hours", "slots useful [%]", "driver busy [%]", "retries", "failed")
    return Table(f"{JOBS} recordings, one driver", columns, (*rows,))


if __name__ == "__main__":
    main()
