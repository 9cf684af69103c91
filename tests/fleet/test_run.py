from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from calibgraph import load_correspondences, load_rig, solve
from calibgraph.errors import CalibrationError, FileError
from calibgraph.fleet.engines import ProcessEngine
from calibgraph.fleet.rows import read_rows
from calibgraph.fleet.run import Summary, run_fleet
from calibgraph.fleet.task import RETRIES, Limits, Outcome, Task
from tests.draws.fleets import write_fleet

POISON = Path(__file__).parent / "poison"
GOOD, ILL, BROKEN = "car-00001", ("segfault", "hungry", "endless", "bug"), "broken"
# 3 GB: a child's libraries reserve under 1 GB, the hungry one takes 8 GB.
LIMITS = Limits(timeout_s=15.0, memory_bytes=3 * 10**9)  # a good job takes 1 s on an idle machine


@dataclass(frozen=True)
class Fleet:
    folder: Path
    manifest: str
    out: str
    summary: Summary
    starts: Counter[str]

    @property
    def rows(self) -> dict[tuple[str, str], dict[str, object]]:
        rows = read_rows(self.out).to_pylist()
        found = {(row["vehicle"], row["camera"]): row for row in rows}
        assert len(found) == len(rows)
        return found


def count_starts(folder: Path) -> Counter[str]:
    return Counter({path.name: path.read_text().count("start") for path in folder.iterdir()})


@pytest.fixture(scope="module", autouse=True)
def _fewer_retries() -> Iterator[None]:
    """Each retry of a dead process starts another, which takes a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RETRIES, "worker died", 1)
        yield


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    """A good vehicle, four whose process comes to grief, and one with a broken table."""
    folder = tmp_path_factory.mktemp("fleet")
    manifest = write_fleet(folder / "in", 2)
    header, _, good = manifest.read_text().splitlines(keepends=True)
    text = header + good
    for number, name in enumerate((*ILL, BROKEN)):
        shutil.copy(folder / "in" / f"{GOOD}.parquet", folder / "in" / f"{name}.parquet")
        text += f'"{name}","{name}.parquet","nominal.yaml","{number}",7\n'
    (folder / "in" / f"{BROKEN}.parquet").write_bytes(b"PAR1 and no more")
    manifest.write_text(text)
    (folder / "starts").mkdir()
    (folder / "here" / "calibgraph").mkdir(parents=True)
    (folder / "here" / "calibgraph" / "__init__.py").write_text("raise ImportError('another one')")
    out = str(folder / "out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(POISON), prepend=":")
        patch.setenv("COUNT_STARTS", str(folder / "starts"))
        patch.chdir(folder / "here")  # a package there is not taken for the installed one
        summary = run_fleet(str(manifest), out, limits=LIMITS, slots=2)
    return Fleet(folder, str(manifest), out, summary, count_starts(folder / "starts"))


def test_poison_stops_no_other_vehicle_and_becomes_rows(fleet: Fleet) -> None:
    rows = fleet.rows
    good = {(GOOD, camera) for camera in ("image_2", "image_3")}
    assert set(rows) == good | {(name, "") for name in (*ILL, BROKEN)}
    kinds = {name: rows[name, ""]["error_kind"] for name in (*ILL, BROKEN)}
    assert kinds == {
        "segfault": "worker died",
        "hungry": "out of memory",
        "endless": "timeout",
        "bug": "internal error",
        "broken": "bad input",
    }
    assert "ended by SIGSEGV" in str(rows["segfault", ""]["error"])
    assert "is it complete? write it again" in str(rows[BROKEN, ""]["error"])
    assert fleet.summary.failures == Counter(kinds.values())


def test_each_kind_of_failure_is_tried_as_often_as_its_limit(fleet: Fleet) -> None:
    kinds = {name: fleet.rows[name, ""]["error_kind"] for name in (*ILL, BROKEN)}
    expected = {name: 1 + RETRIES[kind] for name, kind in kinds.items()}  # type: ignore[index]
    assert fleet.starts == {GOOD: 1, **expected}
    assert fleet.summary.retries == sum(expected.values()) - len(expected)


def test_rows_are_what_solve_gives(fleet: Fleet) -> None:
    folder = Path(fleet.manifest).parent
    rig = load_rig(folder / "nominal.yaml")
    result = solve(rig, load_correspondences(folder / f"{GOOD}.parquet"))
    for camera, T in result.T_camera_lidar.items():
        row = fleet.rows[GOOD, camera]
        assert row["verdict"] == result.camera_verdicts[camera].status
        assert row["cannot_tell"] == result.camera_verdicts[camera].cannot_tell
        assert row["of"] == "alignment"
        doubt = result.camera_verdicts[camera].error_probability
        assert doubt is not None
        assert row["probability_off"] == pytest.approx(doubt.probability, rel=1e-3)
        # The sums of one thread and of several differ in their rounding.
        np.testing.assert_allclose(np.reshape(row["T_camera_lidar"], (4, 4)), T, atol=1e-9)
        np.testing.assert_allclose(
            np.reshape(row["covariance"], (6, 6)), result.covariance[camera], rtol=1e-6, atol=1e-12
        )


def test_columns_of_the_manifest_are_carried(fleet: Fleet) -> None:
    mileages = {name: row["mileage_km"] for (name, _), row in fleet.rows.items()}
    assert mileages == {GOOD: 1000, **dict.fromkeys((*ILL, BROKEN), 7)}
    assert pa.types.is_string(read_rows(fleet.out).schema.field("batch").type)


def test_a_log_per_vehicle_holds_its_tries(fleet: Fleet) -> None:
    (log,) = (Path(fleet.out) / "_logs").glob("segfault-*.log")
    assert log.read_text().count("failed: worker died") == RETRIES["worker died"]
    (log,) = (Path(fleet.out) / "_logs").glob("bug-*.log")
    assert "KeyError" in log.read_text()


@pytest.mark.slow
@pytest.mark.ci
def test_a_second_run_does_only_what_may_succeed_now(fleet: Fleet) -> None:
    before = read_rows(fleet.out)
    summary = run_fleet(fleet.manifest, fleet.out, limits=LIMITS, slots=3)
    assert summary.skipped == 2
    assert summary.failures == {"bad input": 1}
    after = fleet.rows
    assert {key[0] for key, row in after.items() if row["status"] == "done"} == {GOOD, *ILL}
    for row in before.to_pylist():
        if row["status"] == "done":
            assert after[row["vehicle"], row["camera"]] == row


def test_rows_of_another_version_are_not_mixed(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calibgraph.fleet.run.release", lambda: "9.9")
    with pytest.raises(FileError, match=r"holds rows of calibgraph .*, this is 9.9; choose"):
        run_fleet(fleet.manifest, fleet.out)


def test_missing_recordings_are_refused_or_become_rows(fleet: Fleet, tmp_path: Path) -> None:
    manifest = tmp_path / "fleet.csv"
    manifest.write_text("vehicle,recording\na,none\nb,neither\n")
    out = tmp_path / "out"
    with pytest.raises(FileError, match=r"row 0: .*none: nothing is there \(and 1 more\)"):
        run_fleet(str(manifest), str(out))
    assert not out.exists()
    summary = run_fleet(str(manifest), str(out), allow_missing=True)
    assert summary.failures == {"bad input": 2}
    assert run_fleet(str(manifest), str(out), allow_missing=True).skipped == 0


class LostCluster(ProcessEngine):
    """Runs one task; then all workers are gone, and other tasks wait for ever."""

    def __init__(self) -> None:
        super().__init__(slots=1)
        self._tasks = 0

    def submit(self, task: Task) -> Future[Outcome]:
        self._tasks += 1
        return super().submit(task) if self._tasks == 1 else Future()

    def has_workers(self) -> bool:
        return False


@pytest.mark.slow
def test_a_cluster_without_workers_ends_the_run_and_keeps_finished_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest, out = write_fleet(tmp_path / "in", 2), str(tmp_path / "out")
    monkeypatch.setattr("calibgraph.fleet.run.open_engine", lambda *_: LostCluster())
    monkeypatch.setattr("calibgraph.fleet.driver.LONGEST_WITHOUT_WORKERS_S", 20.0)
    with pytest.raises(CalibrationError, match="no worker for 20 s"):
        run_fleet(str(manifest), out)
    assert {row["vehicle"] for row in read_rows(out).to_pylist()} == {"car-00000"}
