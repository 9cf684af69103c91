import json
from pathlib import Path

import pytest

from calibgraph.child_process import Outcome
from calibgraph.fleet.files import read_rows
from tests.conftest import Call
from tests.draws.fleets import run_here, write_fleet


def test_a_manifest_becomes_rows_and_a_page_and_a_second_call_does_nothing(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process: tests/fleet has the processes."""
    monkeypatch.setattr("calibgraph.fleet.run.run_job", run_here)
    manifest, out = str(write_fleet(tmp_path / "in", 2)), str(tmp_path / "out")
    code, printed, _ = call("fleet", manifest, "--out", out, "--jobs", 1, "--json")
    assert code == 0
    first = json.loads(printed)
    assert (first["jobs"], first["skipped"], first["failures"]) == (2, 0, {})
    assert sum(first["verdicts"].values()) == len(read_rows(out)) == 4
    code, _, err = call("fleet", manifest, "--out", out)
    assert code == 0
    assert "2 jobs, 2 finished before; cameras: 4 PASS, 0 WARN, 0 FAIL" in err
    assert "2 vehicles, 4 cameras measured; 0 cameras of 0 vehicles stand apart" in err
    for name in ("fleet.html", "fleet_model.json", "estimates.parquet"):
        assert (Path(out) / name).is_file()
    with (tmp_path / "in" / "nominal.yaml").open("a") as rig:
        rig.write("# of another day\n")
    code, printed, _ = call("fleet", manifest, "--out", out, "--json")
    assert json.loads(printed)["skipped"] == 0, "the input has changed"


def test_failed_jobs_exit_1(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    failed = Outcome(error_kind="bad input", error="empty")
    monkeypatch.setattr("calibgraph.fleet.run.run_job", lambda *_: failed)
    (tmp_path / "fleet.csv").write_text("vehicle,recording\na,drive\n")
    code, _, err = call("fleet", str(tmp_path / "fleet.csv"), "--out", str(tmp_path / "out"))
    assert code == 1
    assert "failed: 1 (bad input); see the column error, and _logs" in err
