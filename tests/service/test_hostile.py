"""Uploads: archives as people make them, and hostile ones, which leave one line and no file."""

import os
import time
from pathlib import Path
from typing import Any

import psutil
import pytest

from calibgraph.child_process import Outcome, memory_limit
from calibgraph.io.dataset import load_dataset
from calibgraph.service.job_process import open_upload, run_job
from tests.conftest import SAMPLE
from tests.service.conftest import Make, Problem, service_folder
from tests.service.hostile import Hostile, as_form, hostile_uploads, zipped

MOST_LETTERS = 2000
MOST_S = 30.0
MEMORY_BYTES = 2 * 10**9
UNPACKED_BYTES = 100_000_000
REFUSED = {400, 413, 415, 422}


@pytest.mark.slow
def test_hostile_uploads_end_in_one_line(
    make_server: Make, small: Problem, monkeypatch: Any, tmp_path: Path
) -> None:
    client = make_server(recording_bytes=UNPACKED_BYTES)
    uploads = hostile_uploads()
    wrong = {
        upload.name: found
        for upload in uploads
        if (found := what_is_wrong(client, upload, small, monkeypatch))
    }
    assert wrong == {}
    assert len({upload.name for upload in uploads}) >= 20
    assert beside(tmp_path) == {"data"}
    assert not list((service_folder(client) / "arriving").iterdir())


def what_is_wrong(client: Any, upload: Hostile, small: Problem, monkeypatch: Any) -> str:
    """What is wrong with the answer to an upload; nothing if it is as it should be."""
    files, fields = as_form(upload, small.rig, small.table)
    start = time.perf_counter()
    answer = client.post(f"/v1/jobs/{upload.kind}", files=files, data=fields)
    outcome = Outcome(error_kind="bad input", error=answer.json().get("detail"))
    if answer.status_code not in REFUSED:
        if answer.status_code != 202:
            return str(answer.text)
        outcome = run(client, answer.json()["id"], monkeypatch)
    seconds, detail = time.perf_counter() - start, outcome.error or ""
    is_one_line = "\n" not in detail and len(detail) < MOST_LETTERS
    has_path = str(service_folder(client)) in detail
    is_refused = outcome.error_kind in ("bad input", "out of memory") and bool(detail)
    is_done = outcome.result is not None and upload.is_harmless
    good = is_one_line and not has_path and seconds < MOST_S and (is_refused or is_done)
    return "" if good else f"{outcome} after {seconds:.1f} s"


def run(client: Any, id: str, monkeypatch: Any) -> Outcome:
    """Run a job as its process does, with its limit of memory."""
    task = client.app.state.service.task(client.app.state.service.jobs.get(id))
    monkeypatch.chdir(os.getcwd())  # it goes back there
    held = psutil.Process().memory_info().data
    with memory_limit(held + MEMORY_BYTES):
        return run_job(task, lambda _: None)


def beside(folder: Path) -> set[str]:
    """What lies where only the server's folder should."""
    return {path.name for path in folder.iterdir()}


@pytest.mark.filterwarnings("ignore:Exception ignored:pytest.PytestUnraisableExceptionWarning")
def test_a_form_that_breaks_off_leaves_nothing(make_server: Make) -> None:
    client = make_server()
    kind = {"Content-Type": "multipart/form-data; boundary=b"}
    part = b'--b\r\nContent-Disposition: form-data; name="rig"; filename="rig"\r\n\r\nformat'
    for body in (part, part[:30], b"", b"garbage" * 100, part + b"\r\n--b"):
        answer = client.post("/v1/jobs/solve", content=body, headers=kind)
        assert answer.status_code in (400, 422), body
    folder = service_folder(client)
    assert not list((folder / "arriving").iterdir())
    assert not list((folder / "jobs").iterdir())


def test_limits_hold_while_an_upload_arrives(make_server: Make, small: Problem) -> None:
    client = make_server(recording_bytes=1000)
    sent = []

    def endless() -> Any:
        yield b'--b\r\nContent-Disposition: form-data; name="rig"; filename="rig"\r\n\r\n'
        for _ in range(1000):
            sent.append(1)
            yield b"x" * 1000

    kind = {"Content-Type": "multipart/form-data; boundary=b"}
    assert client.post("/v1/jobs/solve", content=endless(), headers=kind).status_code == 413
    many = [("recording", b"x")] * 101
    assert make_server("other").post("/v1/jobs/calibrate", files=many).status_code == 422
    assert make_server("third").post("/v1/jobs/solve", content=b"x").status_code == 415


JUNK = {"__MACOSX/sample/._rig.yaml": b"x", "__MACOSX/._sample": b"x", ".DS_Store": b"x"}


def files_of_the_sample(top: str = "") -> dict[str, bytes]:
    found = (path for path in sorted(SAMPLE.rglob("*")) if path.is_file())
    return {f"{top}{path.relative_to(SAMPLE).as_posix()}": path.read_bytes() for path in found}


@pytest.mark.parametrize("top", ["", "sample/", "data/My drive (1)/", "lidar/"])
def test_a_zip_of_a_dataset_is_one_in_whichever_folder_it_is(tmp_path: Path, top: str) -> None:
    junk = JUNK | {f"{top}lidar/.DS_Store": b"x", f"{top}lidar/._000000.npy": b"x"}
    upload = tmp_path / "upload"
    upload.write_bytes(zipped(files_of_the_sample(top) | junk | {f"{top}README.md": b"x"}))
    folder = open_upload(upload, tmp_path / "recording", 10**9)
    assert len(load_dataset(folder).frames) == len(load_dataset(SAMPLE).frames)


def test_names_that_lead_out_of_an_archive_lead_nowhere(tmp_path: Path) -> None:
    evil = {"../evil": b"x", "/evil": b"x", "s/../../evil": b"x", "s\\..\\..\\evil": b"x"}
    (tmp_path / "upload").write_bytes(zipped(evil))
    (tmp_path / "in").mkdir()
    open_upload(tmp_path / "upload", tmp_path / "in" / "recording", 10**9)
    assert beside(tmp_path) == {"upload", "in"} and beside(tmp_path / "in") == {"recording"}
