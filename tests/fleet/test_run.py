"""Runs of a manifest, on threads and on Dask: what befalls one job is one row."""

import json
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from calibgraph import load_correspondences, load_rig, solve
from calibgraph.child_process import Outcome
from calibgraph.errors import CalibrationError, FileError
from calibgraph.fleet.files import Store, read_rows
from calibgraph.fleet.job import RELEASE, Limits, run_job
from calibgraph.fleet.manifest import Job, load_manifest
from calibgraph.fleet.run import Summary, dask_executor, run_fleet, thread_executor
from tests.draws.fleets import run_here, write_fleet

POISON = Path(__file__).parent / "poison"
GOOD = "car-00001"
ILL = {
    "killed": "worker died",
    "hungry": "out of memory",
    "endless": "timeout",
    "bug": "internal error",
    "broken": "bad input",
}
# 3 GB: a child's libraries reserve under 1 GB, the hungry one takes 8 GB.
LIMITS = Limits(timeout_s=60.0, memory_bytes=3 * 10**9)  # a good job takes 1 s on an idle machine


def run_impatiently(job: Job, limits: Limits, of_release: str) -> Outcome:
    """Run a job; the endless one, which would be waited for, has 3 s."""
    seconds = 3.0 if job.vehicle == "endless" else limits.timeout_s
    return run_job(job, replace(limits, timeout_s=seconds), of_release)


@contextmanager
def executor_of(kind: str) -> Iterator[Any]:
    """Two at a time: threads, or a local Dask cluster."""
    if kind == "threads":
        with thread_executor(2) as executor:
            yield executor
        return
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50
        ) as cluster,
        dask_executor(cluster.scheduler_address) as executor,
    ):
        yield executor


def rows_of(out: str, *, seconds: bool = False) -> dict[tuple[str, str], dict[str, Any]]:
    """Rows by vehicle and camera, each there once."""
    rows = read_rows(out).to_pylist()
    found = {(row["vehicle"], row["camera"]): row for row in rows}
    assert len(found) == len(rows)
    for row in [] if seconds else rows:
        del row["seconds"]
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good vehicle in fleet.csv; that and one of each ill in ill.csv."""
    folder = tmp_path_factory.mktemp("fleet")
    head, _, good = write_fleet(folder, 2).read_text().splitlines(keepends=True)
    (folder / "fleet.csv").write_text(text := head + good)
    for name in ILL:
        shutil.copy(folder / f"{GOOD}.parquet", folder / f"{name}.parquet")
        text += f'"{name}","{name}.parquet","nominal.yaml","1",7\n'
    (folder / "broken.parquet").write_bytes(b"PAR1 and no more")
    (folder / "ill.csv").write_text(text)
    return folder


@pytest.fixture(scope="module")
def alone(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    """The rows of the good vehicle when there are no others."""
    with thread_executor(1) as executor:
        run_fleet(
            str(folder / "fleet.csv"), str(folder / "alone"), executor=executor, limits=LIMITS
        )
    return rows_of(str(folder / "alone"))


@dataclass(frozen=True)
class Run:
    kind: str
    manifest: str
    out: str
    summary: Summary


@pytest.fixture(scope="module", params=["threads", pytest.param("dask", marks=pytest.mark.slow)])
def run(request: pytest.FixtureRequest, folder: Path) -> Run:
    """The manifest with all ills, in a folder whose package is not taken for the installed one."""
    here = folder / request.param / "calibgraph"
    here.mkdir(parents=True)
    (here / "__init__.py").write_text("raise ImportError('another one')")
    manifest, out = str(folder / "ill.csv"), str(folder / request.param / "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(POISON), prepend=":")
        patch.chdir(here.parent)
        if request.param == "threads":  # processes of Dask do not know this module
            patch.setattr("calibgraph.fleet.run.run_job", run_impatiently)
        with executor_of(request.param) as executor:
            summary = run_fleet(manifest, out, executor=executor, limits=LIMITS)
    return Run(request.param, manifest, out, summary)


@pytest.mark.filterwarnings("default")
def test_each_ill_is_one_failed_row_and_all_others_are_as_without_it(
    run: Run, alone: dict[tuple[str, str], dict[str, Any]]
) -> None:
    rows = rows_of(run.out)
    failed = {vehicle: row["error_kind"] for (vehicle, camera), row in rows.items() if not camera}
    assert failed == ILL
    assert run.summary.failures == Counter(ILL.values())
    assert "ended by SIGKILL; was the memory enough?" in rows["killed", ""]["error"]
    assert "is it complete? write it again" in rows["broken", ""]["error"]
    assert {key: row for key, row in rows.items() if key[1]} == alone
    (log,) = (Path(run.out) / "_logs").glob("bug-*.log")
    assert "KeyError" in log.read_text()
    assert not children()


@pytest.mark.filterwarnings("default")
def test_the_next_run_does_what_may_succeed_now_and_nothing_else(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = rows_of(run.out, seconds=True)
    if run.kind == "threads":  # a process for each has been tested
        monkeypatch.setattr("calibgraph.fleet.run.run_job", run_here)
    with executor_of(run.kind) as executor:
        summary = run_fleet(run.manifest, run.out, executor=executor, limits=LIMITS)
    assert (summary.skipped, summary.failures) == (2, {"bad input": 1})
    after = rows_of(run.out, seconds=True)
    assert {vehicle for vehicle, camera in after if camera} == {GOOD, *ILL} - {"broken"}
    assert all(after[key] == row for key, row in before.items() if row["status"] == "done")


def test_rows_are_what_solve_gives(
    folder: Path, alone: dict[tuple[str, str], dict[str, Any]]
) -> None:
    rig = load_rig(folder / "nominal.yaml")
    result = solve(rig, load_correspondences(folder / f"{GOOD}.parquet"))
    for camera, T in result.T_camera_lidar.items():
        row, verdict = alone[GOOD, camera], result.camera_verdicts[camera]
        found = row["verdict"], row["cannot_tell"], row["of"], row["batch"], row["mileage_km"]
        assert found == (verdict.status, verdict.cannot_tell, "alignment", 1, 1000)
        assert verdict.error_probability is not None
        probability = verdict.error_probability.probability
        assert row["probability_off"] == pytest.approx(probability, rel=1e-3)
        # The sums of one thread and of several differ in their rounding.
        np.testing.assert_allclose(np.reshape(row["T_camera_lidar"], (4, 4)), T, atol=1e-9)
        covariance = np.reshape(row["covariance"], (6, 6))
        np.testing.assert_allclose(covariance, result.covariance[camera], rtol=1e-6, atol=1e-12)


def test_rows_and_workers_of_another_version_are_refused(
    folder: Path, alone: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest = str(folder / "fleet.csv")
    with pytest.raises(CalibrationError, match=f"a worker has calibgraph {RELEASE}, the command"):
        run_job(load_manifest(manifest)[0][0], Limits(), "9.9")
    monkeypatch.setattr("calibgraph.fleet.run.RELEASE", "9.9")
    with pytest.raises(FileError, match=r"holds rows of calibgraph .*, this is 9.9; choose"):
        run_fleet(manifest, str(folder / "alone"))


def test_missing_recordings_become_rows_that_are_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibgraph.fleet.run.run_job", run_here)
    manifest, out = tmp_path / "fleet.csv", str(tmp_path / "out")
    manifest.write_text("vehicle,recording\na,none\nb,neither\n")
    for _ in range(2):
        summary = run_fleet(str(manifest), out)
        assert (summary.skipped, summary.failures) == (0, {"bad input": 2})
    assert "none" in rows_of(out)["a", ""]["error"]


def test_two_commands_do_not_write_to_one_folder(folder: Path, tmp_path: Path) -> None:
    with Store(str(tmp_path)).locked(), pytest.raises(FileError, match="another command writes"):
        run_fleet(str(folder / "fleet.csv"), str(tmp_path))


def test_dask_without_its_package_or_scheduler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(CalibrationError, match="--dask nonsense://x: no scheduler"):
        dask_executor("nonsense://x").__enter__()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(CalibrationError, match=r"pip install 'calibgraph\[fleet\]'"):
        dask_executor("tcp://host:1").__enter__()


@pytest.mark.slow
def test_a_killed_command_leaves_rows_that_the_next_one_keeps(tmp_path: Path) -> None:
    manifest, out = str(write_fleet(tmp_path / "in", 12)), tmp_path / "out"
    command = [sys.executable, "-m", "calibgraph", "fleet", manifest, "--out", str(out), "--json"]
    codes = {signal.SIGINT: (130, 0), signal.SIGTERM: (130, 0), signal.SIGKILL: (-9, 0)}
    for stop, allowed in codes.items():
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        published, end = len(files_below(out)), time.monotonic() + 120
        while len(files_below(out)) == published and process.poll() is None:
            assert time.monotonic() < end
            time.sleep(0.1)
        below = []
        if process.poll() is None:  # it may have done all by now
            below = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(stop)
        code = process.wait(60)
        if code == -stop != -signal.SIGKILL:  # while it ends, it ends by the signal itself
            assert len(read_rows(str(out))) == 24, "before all was written"
        else:
            assert code in allowed
        psutil.wait_procs(below, timeout=60)  # one that still loads its libraries ends after that
        assert not any(child.is_running() for child in below)
    before = {row["vehicle"]: row["seconds"] for row in read_rows(str(out)).to_pylist()}
    last = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    assert last["skipped"] == len(before) > 0
    rows = read_rows(str(out)).to_pylist()
    assert len(rows) == 24
    assert before.items() <= {row["vehicle"]: row["seconds"] for row in rows}.items()


def files_below(out: Path) -> list[Path]:
    return list(out.glob("rows/*.parquet"))


def children() -> list[psutil.Process]:
    """The processes of jobs below this one."""
    return [child for child in psutil.Process().children(recursive=True)
            if "calibgraph.fleet.job" in child.cmdline()]  # fmt: skip
