"""A job in its process: its input is made ready, one library call made, its result written."""

import json
import os
import shutil
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibgraph.audit import audit_summary, check
from calibgraph.audit.page import write_audit_report
from calibgraph.child_process import (
    Note,
    Outcome,
    answer_requests,
    failed,
    memory_limit,
    output_to,
)
from calibgraph.errors import FileError, in_words
from calibgraph.files import sha256, write_text
from calibgraph.io.dataset import load_dataset
from calibgraph.io.rigs import load_rig
from calibgraph.matching.named import structure_matcher
from calibgraph.model.calibration import Calibration
from calibgraph.model.result_files import REPORT_FILE
from calibgraph.pipeline import calibrate, solve
from calibgraph.progress import Progress
from calibgraph.report.as_json import result_summary
from calibgraph.report.html import write_result
from calibgraph.service.requests import (
    ARCHIVE,
    FILES,
    INPUT,
    LOG,
    RIG,
    SCRATCH,
    SUMMARY,
    TABLE,
    WORK,
    CalibrationSettings,
    CheckSettings,
    JobProgress,
    JobTask,
    SolveSettings,
    recording_name,
)
from calibgraph.stdout import finite

_NOTE_EVERY_S = 0.1


def run_job(task: JobTask, note: Note) -> Outcome:
    """Run a job; what is wrong with its data is part of the outcome.

    Its paths are relative, so that no answer has one of the server's.
    """
    for name in (WORK, SCRATCH):  # what an earlier try has left
        shutil.rmtree(task.folder / name, ignore_errors=True)
    (task.folder / WORK / FILES).mkdir(parents=True)
    (task.folder / SCRATCH).mkdir()
    os.chdir(task.folder / SCRATCH)
    run = {"solve": _solve, "calibrate": _calibrate, "check": _check}[task.job.kind]
    try:
        return run(task, _progress(note))
    except Exception as error:
        places = {f"{task.folder}/{SCRATCH}/": "", str(task.folder): ""}
        if isinstance(error, OSError):  # whose text may name the server's files
            places = {str(error): error.strerror or type(error).__name__}
        return failed(error, places)


def _input(task: JobTask, name: str) -> Path | None:
    """An input, made ready in the working folder; None if it was not given."""
    upload = task.folder / INPUT / name
    if not upload.exists():
        return None
    if name in (RIG, TABLE):
        path = Path(f"{name}{'.yaml' if name == RIG else table_suffix(upload)}")
        path.hardlink_to(upload)
        return path
    return open_upload(upload, Path(name), _room(task))


def _room(task: JobTask) -> int:
    """How much of the disk an input may take: half of the free space is left to others."""
    free = shutil.disk_usage(task.folder).free - task.settings.free_bytes
    return max(0, min(task.settings.recording_bytes, free // 2))


def _recordings(task: JobTask) -> list[Path]:
    names = map(recording_name, range(task.job.recordings))
    return [path for name in names if (path := _input(task, name)) is not None]


def _solve(task: JobTask, progress: Progress) -> Outcome:
    settings = SolveSettings.model_validate(task.job.settings)
    rig, table = _input(task, RIG), _input(task, TABLE)
    assert rig is not None and table is not None  # of each job
    progress("solving", 0, 1)
    result = solve(load_rig(rig), table, settings.config, settings.terms)
    result = replace(result, inputs={str(table): sha256(table)})
    return _write(task, result, with_report=settings.report)


def _calibrate(task: JobTask, progress: Progress) -> Outcome:
    settings = CalibrationSettings.model_validate(task.job.settings)
    rig = _input(task, RIG)
    guess = None if rig is None else load_rig(rig)
    data = load_dataset(_recordings(task), guess, frames=settings.frames)
    matcher = structure_matcher(
        seed=settings.config.seed,
        all_frames=settings.frames is not None,
        search_deg=settings.search_deg,
        search_m=settings.search_m,
    )
    most_s = task.settings.job_timeout_s / 2  # the rest is for the checks and the report
    result = calibrate(
        data,
        matcher=_input(task, TABLE) or matcher,
        config=settings.config,
        terms=settings.terms,
        time_limit_s=min(settings.time_limit_s or most_s, most_s),
        progress=progress,
    )
    progress("writing", 0, 1)
    return _write(task, result, with_report=settings.report)


def _write(task: JobTask, result: Calibration, *, with_report: bool) -> Outcome:
    written = write_result(result, task.folder / WORK / FILES, with_report=with_report)
    _write_summary(task, result_summary(result, [Path(path.name) for path in written]))
    return Outcome((result.verdict.status, result.verdict.cannot_tell))


def _check(task: JobTask, progress: Progress) -> Outcome:
    settings = CheckSettings.model_validate(task.job.settings)
    rig = _input(task, RIG)
    assert rig is not None  # of each job
    data = load_dataset(_recordings(task), load_rig(rig), frames=settings.frames)
    audit = check(
        rig,
        data,
        tolerance_deg=settings.tolerance_deg,
        tolerance_cm=settings.tolerance_cm,
        matcher=structure_matcher(seed=settings.seed, all_frames=settings.frames is not None),
        seed=settings.seed,
        progress=progress,
    )
    progress("writing", 0, 1)
    write_audit_report(audit, task.folder / WORK / FILES / REPORT_FILE)
    _write_summary(task, audit_summary(audit))
    return Outcome((audit.status, audit.status == "CANNOT TELL"))


def _write_summary(task: JobTask, summary: dict[str, Any]) -> None:
    """Write the summary, and the archive of all files, which are there."""
    work = task.folder / WORK
    write_text(work / SUMMARY, json.dumps(finite(summary), allow_nan=False))
    shutil.make_archive(str((work / ARCHIVE).with_suffix("")), "zip", work / FILES)


def _progress(note: Note) -> Progress:
    """A callback that prints each stage, and sends some of the steps to the server."""
    start, last_s, stage = time.perf_counter(), 0.0, ""

    def progress(what: str, done: int, total: int) -> None:
        nonlocal last_s, stage
        now = time.perf_counter()
        if what != stage:
            print(f"{now - start:8.1f} s  {what}", flush=True)
        elif now - last_s < _NOTE_EVERY_S:
            return
        stage, last_s = what, now
        note(JobProgress(stage=what, done=done, total=total))

    return progress


def _answer(task: JobTask, note: Note) -> Outcome:
    with output_to(task.folder / LOG), memory_limit(task.settings.memory_bytes):
        return run_job(task, note)


MOST_FILES = 100_000
_MOST_LETTERS = 250  # of a name; file systems hold 255 bytes
_OF_FILE_MANAGERS = ("__MACOSX", "Thumbs.db", "desktop.ini")
_BAGS = {b"#ROSBAG V2.0": ".bag", b"\x89MCAP0\r\n": ".mcap", b"SQLite format 3\0": ".db3"}
_ZIP = b"PK\x03\x04"


def open_upload(upload: Path, target: Path, most_bytes: int) -> Path:
    """The recording in an upload, by its first bytes: linked, or unpacked into a folder.

    Args:
        upload: the file, which stays as it is.
        target: of the folder, or of the bag without its suffix.
        most_bytes: of all unpacked files.

    Raises:
        FileError: if it is neither, or an archive is damaged or holds too much.
    """
    with upload.open("rb") as file:
        head = file.read(16)
    for mark, suffix in _BAGS.items():
        if head.startswith(mark):
            bag = target.with_name(target.name + suffix)
            bag.hardlink_to(upload)
            return bag
    if not head.startswith(_ZIP):
        raise FileError(target, "is no .zip of a dataset folder, and no bag (.bag, .mcap, .db3)")
    try:
        _unpack(upload, target, most_bytes)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError,
            FileExistsError, NotADirectoryError, IsADirectoryError) as error:  # fmt: skip
        raise FileError(target, f"cannot be unpacked ({in_words(error)}); make it again") from error
    return _dataset_in(target)


def table_suffix(path: Path) -> str:
    """The suffix of an uploaded table by its first bytes: Parquet, else CSV."""
    with path.open("rb") as file:
        return ".parquet" if file.read(4) == b"PAR1" else ".csv"


def _unpack(packed: Path, folder: Path, most_bytes: int) -> None:
    """Unpack an archive into a folder, if its names and sizes are as they should be.

    Zipfile itself writes to no place outside of the folder, makes no links, and reads no more of a
    file than its stated size.
    """
    with zipfile.ZipFile(packed) as archive:
        files = [each for each in archive.infolist() if not _is_hidden(each.filename)]
        size = sum(each.file_size for each in files)
        if len(files) > MOST_FILES:
            raise FileError(folder.name, f"{len(files)} files, expected up to {MOST_FILES}")
        if size > most_bytes:
            why = f"{size} bytes when unpacked, expected up to {most_bytes}; send less of it"
            raise FileError(folder.name, why)
        if any(len(each.filename) > _MOST_LETTERS for each in files):
            raise FileError(folder.name, f"has names of over {_MOST_LETTERS} letters; rename them")
        folder.mkdir()
        archive.extractall(folder, files)


def _is_hidden(name: str) -> bool:
    """Whether a file is one that file managers add."""
    parts = [part for part in name.split("/") if part]
    return any(part.startswith(".") or part in _OF_FILE_MANAGERS for part in parts)


def _dataset_in(folder: Path) -> Path:
    """The folder of the dataset: the first that holds more than one other folder."""
    while len(inside := [*folder.iterdir()]) == 1 and inside[0].is_dir():
        folder = inside[0]
    return folder


if __name__ == "__main__":
    answer_requests(_answer)
