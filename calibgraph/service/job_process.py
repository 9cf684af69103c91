"""A job in its process: its input is made ready, one library call made, its result written."""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibgraph.child_process import Note, answer_requests, memory_limit, output_to
from calibgraph.errors import CalibrationError
from calibgraph.files import write_text
from calibgraph.fleet.task import describe_failure
from calibgraph.fleet.uris import fetch
from calibgraph.model.result_files import REPORT_FILE
from calibgraph.service.archives import open_upload, table_suffix
from calibgraph.service.places import require_inside
from calibgraph.service.requests import (
    FILES,
    INPUT,
    LOG,
    RIG,
    SUMMARY,
    TABLE,
    WORK,
    CalibrationSettings,
    CheckSettings,
    JobOutcome,
    JobProgress,
    JobTask,
    SolveSettings,
    recording_name,
)

if TYPE_CHECKING:
    from calibgraph.model.calibration import Calibration
    from calibgraph.progress import Progress

_NOTE_EVERY_S = 0.1
_KNOWN_SUFFIXES = (".bag", ".mcap", ".db3", ".parquet", ".csv", ".yaml", ".yml", ".txt")


@dataclass(frozen=True)
class _Inputs:
    """The inputs of a job, made ready."""

    rig: Path | None
    table: Path | None
    recordings: list[Path]


def run_job(task: JobTask, note: Note) -> JobOutcome:
    """Run a job; what is wrong with its data is part of the outcome.

    Its paths are relative, so that no answer has one of the server's.
    """
    shutil.rmtree(task.folder / WORK, ignore_errors=True)
    (task.folder / WORK / FILES).mkdir(parents=True)
    os.chdir(task.folder / INPUT)
    try:
        return _run(task, _progress(note))
    except Exception as error:
        kind, text = describe_failure(error)
        if isinstance(error, OSError):  # whose text may name the server's files
            text = error.strerror or type(error).__name__
    text = text.replace(f"{task.folder}/{INPUT}/", "").replace(str(task.folder), "")
    return JobOutcome(error_kind=kind, error=str(CalibrationError(text)))


def _run(task: JobTask, progress: Progress) -> JobOutcome:
    """Make the result."""
    found = (_found(task, recording_name(i)) for i in range(task.job.recordings))
    recordings = [path for path in found if path is not None]
    inputs = _Inputs(_found(task, RIG), _found(task, TABLE), recordings)
    run: Callable[[JobTask, _Inputs, Progress], JobOutcome]
    run = {"solve": _solve, "calibration": _calibrate, "check": _check}[task.job.kind]
    return run(task, inputs, progress)


def _found(task: JobTask, name: str) -> Path | None:
    """The input of a name, made ready once: a job that is run again finds it."""
    ready = [path for path in Path().glob(f"{name}.*") if path.suffix in _KNOWN_SUFFIXES]
    if ready:
        return ready[0]
    path, uri = Path(name), task.job.uris.get(name)
    if uri is not None:
        return path if path.exists() else _link(task, uri, name)
    if not path.exists():
        return None
    if name == RIG:
        return path.rename(path.with_suffix(".yaml"))
    if name == TABLE:
        return path.rename(path.with_suffix(table_suffix(path)))
    return (
        path
        if path.is_dir() and not _is_partial(path)
        else open_upload(_restored(path), _room(task, task.settings.upload_bytes))
    )


def _room(task: JobTask, most_bytes: int) -> int:
    """How much of the disk an input may take: half of the free space is left to others."""
    free = shutil.disk_usage(task.folder).free - task.settings.free_bytes
    return max(0, min(most_bytes, free // 2))


def _is_partial(folder: Path) -> bool:
    """Whether an archive is half unpacked: it is removed at the end."""
    return folder.with_name(folder.name + ".packed").exists()


def _restored(path: Path) -> Path:
    """The upload, in place of a folder that is half of it."""
    packed = path.with_name(path.name + ".packed")
    if packed.exists():
        shutil.rmtree(path, ignore_errors=True)
        packed.rename(path)
    return path


def _link(task: JobTask, uri: str, name: str) -> Path:
    """A link to what is at a URI, or to the copy of what is remote."""
    require_inside(uri, task.roots)
    copies = Path(f"{name}_copy")
    shutil.rmtree(copies, ignore_errors=True)
    copies.mkdir()
    try:
        found = fetch(uri, copies, _room(task, task.settings.fetch_bytes))
    except (CalibrationError, OSError, MemoryError):
        raise
    except Exception as error:  # of any store's client
        raise OSError(0, f"{uri}: cannot be fetched ({type(error).__name__})") from error
    suffix = found.suffix if found.suffix in _KNOWN_SUFFIXES else ""
    link = Path(f"{name}{suffix}")
    link.symlink_to(found)
    return link


def _solve(task: JobTask, inputs: _Inputs, progress: Progress) -> JobOutcome:
    from calibgraph.files import sha256
    from calibgraph.io.rigs import load_rig
    from calibgraph.pipeline import solve

    settings = SolveSettings.model_validate(task.job.settings)
    rig, table = inputs.rig, inputs.table
    if rig is None or table is None:
        raise ValueError("a solve needs a rig and correspondences")
    progress("solving", 0, 1)
    result = solve(load_rig(rig), table, settings.config, settings.terms)
    result = result.with_inputs({str(table): sha256(table)})
    return _write(task, result, None, with_report=settings.report)


def _calibrate(task: JobTask, inputs: _Inputs, progress: Progress) -> JobOutcome:
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.structure import StructureMatcher
    from calibgraph.pipeline import calibrate

    settings = CalibrationSettings.model_validate(task.job.settings)
    rig, table = load_rig(inputs.rig) if inputs.rig else None, inputs.table
    data = load_dataset(inputs.recordings, rig, frames=settings.frames)
    options: dict[str, Any] = {"search_deg": settings.search_deg, "search_m": settings.search_m}
    if settings.search:
        options = {name: value for name, value in options.items() if value is not None}
    if settings.frames is not None:
        options["most_frames"] = None
    matcher = StructureMatcher(seed=settings.config.seed, **options) if table is None else table
    most_s = task.settings.job_timeout_s / 2  # the rest is for the checks and the report
    result = calibrate(
        data,
        matcher=matcher,
        config=settings.config,
        terms=settings.terms,
        time_limit_s=min(settings.time_limit_s or most_s, most_s),
        progress=progress,
    )
    progress("writing", 0, 1)
    return _write(task, result, data, with_report=settings.report)


def _write(task: JobTask, result: Calibration, data: Any, *, with_report: bool) -> JobOutcome:
    from calibgraph.report.as_json import result_summary
    from calibgraph.report.html import write_result

    written = write_result(result, task.folder / WORK / FILES, data, with_report=with_report)
    _write_summary(task, result_summary(result, [Path(path.name) for path in written]))
    return JobOutcome(result.verdict.status, result.verdict.cannot_tell)


def _check(task: JobTask, inputs: _Inputs, progress: Progress) -> JobOutcome:
    from calibgraph.audit import audit_summary, check
    from calibgraph.audit.check import provenance
    from calibgraph.audit.page import write_audit_report
    from calibgraph.io.dataset import load_dataset
    from calibgraph.io.rigs import load_rig
    from calibgraph.matching.structure import StructureMatcher

    settings = CheckSettings.model_validate(task.job.settings)
    if inputs.rig is None:
        raise ValueError("a check needs the deployed rig")
    deployed = load_rig(inputs.rig)
    options: dict[str, Any] = {} if settings.frames is None else {"most_frames": None}
    data = load_dataset(inputs.recordings, deployed, frames=settings.frames)
    origin = provenance(inputs.rig, data)
    audit = check(
        deployed,
        data,
        tolerance_deg=settings.tolerance_deg,
        tolerance_cm=settings.tolerance_cm,
        matcher=StructureMatcher(seed=settings.seed, **options),
        seed=settings.seed,
        progress=progress,
    )
    audit = replace(audit, same_recording=origin.same_recording, deployed_verdict=origin.verdict)
    progress("writing", 0, 1)
    write_audit_report(audit, task.folder / WORK / FILES / REPORT_FILE)
    _write_summary(task, audit_summary(audit))
    return JobOutcome(audit.status, audit.status == "CANNOT TELL")


def _write_summary(task: JobTask, summary: dict[str, Any]) -> None:
    from calibgraph.report.as_json import finite

    text = json.dumps(finite(summary), allow_nan=False)
    write_text(task.folder / WORK / SUMMARY, text)


def _progress(note: Note) -> Progress:
    """A callback that prints each stage, and sends some of the steps to the server."""
    start, last_s, stage = time.perf_counter(), [0.0], [""]

    def progress(what: str, done: int, total: int) -> None:
        now = time.perf_counter()
        if what != stage[0]:
            print(f"{now - start:8.1f} s  {what}", flush=True)
        elif now - last_s[0] < _NOTE_EVERY_S:
            return
        stage[0], last_s[0] = what, now
        note(JobProgress(stage=what, done=done, total=total))

    return progress


def main() -> None:
    """The process: one job at a time."""
    import calibgraph.pipeline  # noqa: F401 - it takes seconds, which are not the first job's
    import calibgraph.report.html  # noqa: F401

    def answer(task: JobTask, note: Note) -> JobOutcome:
        with output_to(task.folder / LOG), memory_limit(task.settings.job_memory_bytes):
            return run_job(task, note)

    answer_requests(answer)


if __name__ == "__main__":
    main()
