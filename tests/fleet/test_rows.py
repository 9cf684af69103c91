"""Rows and inputs at local paths and at URIs."""

import os
import shutil
import sys
from pathlib import Path

import fsspec
import pyarrow as pa
import pytest
from pyarrow import parquet

from calibgraph import CalibrationError, FileError
from calibgraph.fleet.files import (
    ROWS,
    SCHEMA,
    Store,
    fetch,
    fingerprint,
    join,
    read_bytes,
    read_rows,
)
from calibgraph.fleet.run import run_fleet, thread_executor
from tests.draws.fleets import write_fleet


def publish(uri: str, vehicle: str, camera: str = "front", **others: object) -> None:
    row = {"vehicle": vehicle, "camera": camera, "recording": "drive", "status": "done"}
    table = pa.Table.from_pylist([row], schema=SCHEMA)
    for name, value in others.items():
        table = table.append_column(name, pa.array([value]))
    Store(uri).put(f"{ROWS}/{vehicle}.parquet", table)


@pytest.mark.parametrize("kind", ["local", "memory"])
def test_rows_of_one_job_replace_each_other(tmp_path: Path, kind: str) -> None:
    """A column that only some rows have is null in the others."""
    out = str(tmp_path / "out [1]") if kind == "local" else "memory://fleet-rows"
    publish(out, "a", "")
    publish(out, "b", "", batch="2026-03")
    publish(out, "a", "left")
    Store(out).put("estimates.parquet", pa.table({"vehicle": ["c"]}))  # no rows
    found = read_rows(out).select(["vehicle", "camera", "batch"]).to_pylist()
    assert sorted(map(str, found)) == sorted(map(str, [
        {"vehicle": "a", "camera": "left", "batch": None},
        {"vehicle": "b", "camera": "", "batch": "2026-03"},
    ]))  # fmt: skip


def test_places_without_rows_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "damaged" / ROWS).mkdir(parents=True)
    (tmp_path / "damaged" / ROWS / "a.parquet").write_bytes(b"PAR1")
    for place in (tmp_path, tmp_path / "none", tmp_path / "damaged"):
        with pytest.raises(FileError, match="give what calibgraph fleet wrote"):
            read_rows(str(place))
    with pytest.raises(CalibrationError, match="--out is empty"):
        Store("")
    parquet.write_table(pa.table({"x": [1]}), tmp_path / "one.parquet")
    assert len(read_rows(str(tmp_path / "one.parquet"))) == 1


@pytest.fixture
def drive() -> str:
    """A recording on a store that is not local."""
    memory = fsspec.filesystem("memory")
    if memory.exists("/logs"):
        memory.rm("/logs", recursive=True)
    memory.pipe({"/logs/drive/lidar/0.npy": b"cloud", "/logs/drive/rig.yaml": b"rig"})
    return "memory://logs/drive"


def test_remote_data_are_copied_up_to_the_limit_and_local_ones_read_in_place(
    tmp_path: Path, drive: str
) -> None:
    with pytest.raises(FileError, match=r"expected up to 7e-09 \(--fetch-gb"):
        fetch(drive, tmp_path, 7)
    assert not list(tmp_path.iterdir())
    copied = fetch(drive, tmp_path, 1e6)
    assert copied == tmp_path / "drive"
    assert (copied / "lidar" / "0.npy").read_bytes() == b"cloud"
    assert fetch(f"{drive}/rig.yaml", tmp_path, 1e6).read_bytes() == b"rig"
    assert fetch(str(copied), tmp_path / "none", 0) == copied


def test_fingerprints_change_with_a_remote_file(drive: str) -> None:
    before = fingerprint(drive)
    assert fingerprint(drive) == before
    fsspec.filesystem("memory").pipe_file("/logs/drive/rig.yaml", b"other")
    assert fingerprint(drive) != before
    with pytest.raises(FileNotFoundError):
        fingerprint("memory://logs/none")


def test_relative_paths_start_at_the_folder() -> None:
    assert (join("s3://logs", "a/b"), join("", "a")) == ("s3://logs/a/b", "a")
    for absolute in ("/a", "s3://a", "zip://a::b.zip"):
        assert join("folder", absolute) == absolute


def test_tables_in_an_archive_are_fetched_solved_and_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_fleet(tmp_path / "in", 1).parent
    archive = shutil.make_archive(str(tmp_path / "logs"), "zip", folder)
    text = "vehicle,recording,rig\n"
    for name in ("car-00000", "none"):
        text += f"{name},zip://{name}.parquet::{archive},zip://nominal.yaml::{archive}\n"
    (tmp_path / "fleet.csv").write_text(text)
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    out = str(tmp_path / "out")
    with thread_executor(1) as executor:
        summary = run_fleet(str(tmp_path / "fleet.csv"), out, executor=executor)
    assert summary.failures == {"bad input": 1}
    (error,) = [row["error"] for row in read_rows(out).to_pylist() if row["error"]]
    assert f"zip://none.parquet::{archive}" in error
    assert sum(summary.verdicts.values()) == 2
    assert not list((tmp_path / "scratch").iterdir())


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fleet.csv")
    with pytest.raises(FileError, match="is no file that can be read"):
        read_bytes(str(tmp_path / "fleet.csv"), 1000)


def test_without_fsspec_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(CalibrationError, match=r"pip install 'calibgraph\[fleet\]'"):
        read_bytes("fleet.csv", 1000)
