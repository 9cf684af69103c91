"""The content of the pages for people: jobs, results and trackers in words, and the forms."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibgraph.report.kit import load_template
from calibgraph.service.answers import utc
from calibgraph.service.job_task import JobProgress
from calibgraph.service.jobs import JobRecord
from calibgraph.service.requests import JobKind

_MINUTE_S = 60
_Row = tuple[str, str, str]

_SOLVED: tuple[_Row, ...] = (
    ("Turn, 1 sigma per axis (deg)", "rotation_sigma_deg", ".3f"),
    ("Shift, 1 sigma per axis (cm)", "translation_sigma_cm", ".2f"),
    ("Median residual (px)", "residuals.median_px", ".2f"),
    ("Inliers (share)", "residuals.inlier_share", ".2f"),
)
_AUDITED: tuple[_Row, ...] = (
    ("Turned per axis (deg)", "deviation_deg", ".2f"),
    ("1 sigma (deg)", "sigma_deg", ".2f"),
    ("Shifted per axis (cm)", "deviation_cm", ".1f"),
    ("1 sigma (cm)", "sigma_cm", ".1f"),
)

_QUESTIONS: Mapping[JobKind, str] = {
    "calibration": "can this calibration be used?",
    "solve": "can this calibration be used?",
    "check": "is the deployed calibration still right?",
}


def render(template: str, **content: object) -> str:
    """A page of ``pages/``; all text in it is escaped."""
    return load_template(template, "calibgraph.service", "pages").render(**content)


@dataclass(frozen=True)
class JobView:
    """A job as a page shows it."""

    id: str
    kind: str
    title: str
    note: str
    question: str
    result: str
    created: str
    took: str
    stage: str
    error: str | None
    is_finished: bool


def job_view(record: JobRecord, step: JobProgress | None) -> JobView:
    """A job as a page shows it."""
    took = ""
    if record.started_s is not None and record.finished_s is not None:
        took = _in_words(record.finished_s - record.started_s)
    return JobView(
        id=record.id,
        kind=record.kind,
        title=record.name or f"{record.kind} {record.id[:8]}",
        note=record.note or "",
        question=_QUESTIONS[record.kind],
        result=record.verdict or record.state,
        created=minute_of(record.created_s),
        took=took,
        stage=record.state if step is None else f"{step.stage} {step.done} of {step.total}",
        error=record.error,
        is_finished=record.is_finished,
    )


def minute_of(time_s: float) -> str:
    """A time since 1970 in words."""
    return f"{utc(time_s):%Y-%m-%d %H:%M} UTC"


def _in_words(seconds: float) -> str:
    if seconds < _MINUTE_S:
        return f"{max(seconds, 0):.1f} s"
    return f"{seconds // _MINUTE_S:.0f} min {seconds % _MINUTE_S:.0f} s"


@dataclass(frozen=True)
class CameraView:
    """A camera's row; its numbers are in the order of the columns."""

    name: str
    verdict: str
    numbers: tuple[str, ...]


def camera_table(cameras: Mapping[str, Any]) -> tuple[list[str], list[CameraView]]:
    """Names of the columns, and a row per camera, of a result's or an audit's ``cameras``."""
    is_audit = any("status" in camera for camera in cameras.values())
    rows = _AUDITED if is_audit else _SOLVED
    views = [_camera_view(name, camera, rows) for name, camera in cameras.items()]
    return [title for title, _, _ in rows], views


def _camera_view(name: str, camera: Mapping[str, Any], rows: Sequence[_Row]) -> CameraView:
    verdict = str(camera.get("status") or camera.get("verdict"))
    numbers = tuple(_numbers(camera, path, form) for _, path, form in rows)
    return CameraView(name, verdict, numbers)


def _numbers(camera: Mapping[str, Any], path: str, form: str) -> str:
    """One number, or one per axis; a dash where there is none."""
    value: Any = camera
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    values = value if isinstance(value, list) else [value]
    return "  ".join("-" if each is None else format(each, form) for each in values)


def read_summary(path: Path) -> dict[str, Any]:
    """The summary of a result; an empty one if it has expired meanwhile."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    return content if isinstance(content, dict) else {}


def reasons_of(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Why a result is not PASS, or what a check found: status, cameras and text of each."""
    if "summary" in summary:
        found: list[Mapping[str, Any]] = summary["summary"]["reasons"]
        return found
    cameras: Mapping[str, Mapping[str, Any]] = summary.get("cameras", {})
    return [
        {"status": camera["status"], "cameras": [name], "text": camera["reason"]}
        for name, camera in cameras.items()
    ]


def actions_of(summary: Mapping[str, Any]) -> list[str]:
    """What to do about a result."""
    actions: list[str] = summary.get("summary", {}).get("actions", [])
    return actions


TITLES: Mapping[JobKind, str] = {
    "calibration": "Calibrate a recording",
    "check": "Check a deployed calibration",
    "solve": "Solve a table of correspondences",
}


@dataclass(frozen=True)
class Field:
    """An input of a form; its type is one of HTML's, or textarea."""

    name: str
    label: str
    hint: str = ""
    type: str = "text"
    required: bool = False
    multiple: bool = False


_ABOUT = (
    Field("name", "Name", "For the list of jobs."),
    Field("note", "Note", type="textarea"),
)
_RECORDING = Field(
    "recording", "Recording", "A zip of a dataset folder, or bags.", "file", True, True
)
_RIG = Field("rig", "Guess", "A rig.yaml; without one, that of the recording.", "file")
_FRAMES = Field("frames", "Frames", "Like 0:90:10; without, all or the best 30.")
_FIELDS: Mapping[JobKind, tuple[Field, ...]] = {
    "calibration": (
        _RECORDING,
        _RIG,
        *_ABOUT,
        _FRAMES,
        Field("search_deg", "Search range, deg per axis", "Without, the matcher's.", "number"),
        Field("search_m", "Search range, m per axis", "Without, the matcher's.", "number"),
    ),
    "check": (
        replace(_RIG, label="Deployed calibration", hint="A rig.yaml or calibration.yaml.",
                required=True),
        _RECORDING,
        *_ABOUT,
        Field("tolerance_deg", "Tolerance, deg per axis", "Without, 0.5.", "number"),
        Field("tolerance_cm", "Tolerance, cm per axis", "Without, 10.", "number"),
        _FRAMES,
    ),
    "solve": (
        replace(_RIG, hint="A rig.yaml.", required=True),
        Field("correspondences", "Correspondences", "A .parquet or .csv.", "file", True),
        *_ABOUT,
    ),
}  # fmt: skip


def form_of(kind: JobKind) -> dict[str, Any]:
    """What the template of a new job's page shows."""
    return {"kind": kind, "title": TITLES[kind], "kinds": TITLES.items(), "fields": _FIELDS[kind]}
