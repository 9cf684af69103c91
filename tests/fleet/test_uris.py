from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import fsspec
import pytest

from calibgraph import CalibrationError, FileError
from calibgraph.fleet.rows import read_rows
from calibgraph.fleet.run import run_fleet
from calibgraph.fleet.uris import fetch, fingerprint, in_arrow, join, read_bytes
from tests.draws.fleets import write_fleet


@pytest.fixture
def drive() -> str:
    """A recording on a store that is not local."""
    memory = fsspec.filesystem("memory")
    if memory.exists("/logs"):
        memory.rm("/logs", recursive=True)
    memory.pipe({"/logs/drive/lidar/0.npy": b"cloud", "/logs/drive/rig.yaml": b"rig"})
    return "memory://logs/drive"


def test_local_paths_are_read_in_place(tmp_path: Path) -> None:
    (tmp_path / "drive").mkdir()
    assert fetch(str(tmp_path / "drive"), tmp_path / "none", 0) == tmp_path / "drive"


def test_remote_folders_and_files_are_copied_under_their_names(tmp_path: Path, drive: str) -> None:
    copied = fetch(drive, tmp_path, 1e6)
    assert copied == tmp_path / "drive"
    assert (copied / "lidar" / "0.npy").read_bytes() == b"cloud"
    assert fetch(f"{drive}/rig.yaml", tmp_path, 1e6).read_bytes() == b"rig"


def test_a_remote_recording_may_not_be_larger_than_the_limit(tmp_path: Path, drive: str) -> None:
    with pytest.raises(FileError, match="expected up to 7e-09; see --fetch-gb"):
        fetch(drive, tmp_path, 7)
    assert not list(tmp_path.iterdir())


def test_fingerprints_change_with_a_remote_file(drive: str) -> None:
    before = fingerprint(drive)
    assert fingerprint(drive) == before
    fsspec.filesystem("memory").pipe_file("/logs/drive/rig.yaml", b"other")
    assert fingerprint(drive) != before
    with pytest.raises(FileNotFoundError):
        fingerprint("memory://logs/none")


def test_relative_paths_start_at_the_folder() -> None:
    assert join("s3://logs", "a/b") == "s3://logs/a/b"
    assert join("", "a") == "a"
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
    summary = run_fleet(str(tmp_path / "fleet.csv"), out)
    assert summary.failures == {"bad input": 1}
    (error,) = [row["error"] for row in read_rows(out).to_pylist() if row["error"]]
    assert f"zip://none.parquet::{archive}" in error
    assert sum(summary.verdicts.values()) == 2
    assert not list((tmp_path / "scratch").iterdir())


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fleet.csv")
    with pytest.raises(FileError, match="is no file that can be read"):
        read_bytes(str(tmp_path / "fleet.csv"), 1000)


def test_what_arrow_reads_is_none_of_pythons() -> None:
    """Its threads would need the interpreter to drop it, which may have ended by then."""
    content = os.urandom(100)
    before = sys.getrefcount(content)
    reader = in_arrow(content)
    assert sys.getrefcount(content) == before
    assert reader.read() == content
    assert in_arrow(b"").read() == b""


def test_without_fsspec_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(CalibrationError, match=r"pip install 'calibgraph\[fleet\]'"):
        read_bytes("fleet.csv", 1000)
