from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from calibgraph import CalibrationError
from calibgraph.fleet.engines import ProcessEngine, open_engine
from calibgraph.fleet.manifest import load_manifest
from calibgraph.fleet.rows import read_rows
from calibgraph.fleet.run import run_fleet
from calibgraph.fleet.task import Limits, Outcome, Task, release
from tests.draws.fleets import write_fleet
from tests.fleet.killing import kill_at_random

JOBS, MANY = 12, 100


@pytest.fixture(scope="module")
def manifest(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_fleet(tmp_path_factory.mktemp("fleet"), JOBS))


@pytest.fixture
def engine() -> Iterator[ProcessEngine]:
    made = ProcessEngine(2)
    yield made
    made.close()


def rows_without_seconds(out: Path) -> list[dict[str, object]]:
    rows = read_rows(str(out)).drop_columns(["seconds"]).to_pylist()
    return sorted(rows, key=lambda row: (row["vehicle"], row["camera"]))


def test_a_worker_of_another_version_is_refused(manifest: str, engine: ProcessEngine) -> None:
    job = load_manifest(manifest).jobs[0]
    error = engine.submit(Task(job, Limits(), "9.9")).exception()
    assert isinstance(error, CalibrationError)
    assert f"a worker has calibgraph {release()}, the command 9.9" in str(error)


def test_closing_ends_jobs_and_processes(manifest: str) -> None:
    engine = ProcessEngine(1)
    job = load_manifest(manifest).jobs[0]
    futures = [engine.submit(Task(job, Limits(), release())) for _ in range(50)]
    engine.close()
    assert all(future.done() for future in futures)
    assert not children_of(os.getpid())


def end_all(waiting: list[Future[Outcome]]) -> None:
    for each in waiting:
        with suppress(InvalidStateError):  # it has ended meanwhile
            each.set_result(Outcome(error_kind="bad input", error="none"))


def test_no_more_is_submitted_than_twice_the_slots(manifest: str, tmp_path: Path) -> None:
    class Counting:
        slots, most = 2, 0

        def __init__(self) -> None:
            self.open: list[Future[Outcome]] = []

        def submit(self, task: Task) -> Future[Outcome]:
            """Jobs end once there are twice as many as slots, or no others; not at a time."""
            self.open.append(Future())
            waiting = [each for each in self.open if not each.done()]
            self.most = max(self.most, len(waiting))
            if len(waiting) >= 2 * self.slots or len(self.open) == JOBS:
                threading.Timer(0.1, end_all, (waiting,)).start()
            return self.open[-1]

        def has_workers(self) -> bool:
            return True

        def close(self) -> None:
            """Nothing to release."""

    counting = Counting()
    assert run_fleet(manifest, str(tmp_path), engine=counting).failures == {"bad input": JOBS}
    assert counting.most == 4


@pytest.mark.parametrize("name", ["threads", "ray2", "processes:4"])
def test_an_unknown_engine_is_one_line(name: str) -> None:
    with pytest.raises(CalibrationError, match=f"--engine {name}: known are processes, ray"):
        open_engine(name)


@pytest.mark.parametrize(("name", "module"), [("ray", "ray"), ("dask", "distributed")])
def test_a_missing_package_names_its_extra(
    name: str, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(CalibrationError, match=rf"pip install 'calibgraph\[{name}\]'"):
        open_engine(name)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["ray", "dask"])
def test_clusters_give_the_rows_of_processes(name: str, manifest: str, tmp_path: Path) -> None:
    run_fleet(manifest, str(tmp_path / "processes"), slots=2)
    run_fleet(manifest, str(tmp_path / name), engine=name, slots=2)
    expected = rows_without_seconds(tmp_path / "processes")
    assert len(expected) == 24
    assert rows_without_seconds(tmp_path / name) == expected


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(("name", "most"), [("processes", 20), ("ray", 40), ("dask", 40)])
def test_every_row_is_there_once_though_workers_are_killed(
    name: str, most: int, tmp_path: Path
) -> None:
    # A cluster that gives up workers which it loses while they start has done so after 20 s.
    manifest = str(write_fleet(tmp_path, MANY))  # the last kill comes before the last job
    stop, kills = threading.Event(), [0]
    killer = threading.Thread(target=kill_at_random, args=(stop, kills, most), daemon=True)
    killer.start()
    run_fleet(manifest, str(tmp_path / "out"), engine=name, slots=2)
    stop.set()
    killer.join()
    assert kills == [most]
    run_fleet(manifest, str(tmp_path / "out"), slots=2)
    rows = rows_without_seconds(tmp_path / "out")
    assert len(rows) == len({(row["vehicle"], row["camera"]) for row in rows}) == 2 * MANY


@pytest.mark.slow
def test_a_killed_command_leaves_rows_that_the_next_one_keeps(
    manifest: str, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "calibgraph", "fleet", manifest, "--out", str(tmp_path)]
    # Interrupted while it ends, Python ends by the signal itself, which a shell calls 130 as well.
    codes = {signal.SIGINT: (130, -2, 0), signal.SIGTERM: (130, 0), signal.SIGKILL: (-9, 0)}
    for stop, allowed in codes.items():
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        published, end = len(files_below(tmp_path)), time.monotonic() + 60
        while len(files_below(tmp_path)) == published and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.1)
        below = []
        if process.poll() is None:  # it may have done all by now
            below = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(stop)
        assert process.wait(30) in allowed
        psutil.wait_procs(below, timeout=10)
        assert not any(child.is_running() for child in below)
    before = {row["vehicle"]: row["seconds"] for row in read_rows(str(tmp_path)).to_pylist()}
    assert run_fleet(manifest, str(tmp_path), slots=2).skipped == len(before) > 0
    rows = read_rows(str(tmp_path)).to_pylist()
    assert len(rows) == 24
    assert before.items() <= {row["vehicle"]: row["seconds"] for row in rows}.items()


def files_below(out: Path) -> list[Path]:
    return list(out.glob("bucket=*/rows.parquet"))


def children_of(pid: int) -> list[psutil.Process]:
    """The processes of jobs below a process."""
    found = []
    for child in psutil.Process(pid).children(recursive=True):
        try:
            if "calibgraph.fleet.child" in child.cmdline():
                found.append(child)
        except psutil.Error:
            continue
    return found
