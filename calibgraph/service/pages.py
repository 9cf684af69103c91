"""What the pages for people show: jobs, results and trackers in words."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from calibgraph.service.answers import utc
from calibgraph.service.job_task import Step
from calibgraph.service.jobs import JobRecord

_MARKS = {
    "PASS": "pass", "OK": "pass", "WARN": "warn", "CANNOT TELL": "warn",
    "FAIL": "fail", "WRONG": "fail", "failed": "fail",
}  # fmt: skip
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

_environment = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "pages"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
)


def render(template: str, **content: object) -> str:
    """A page of ``pages/``; all text in it is escaped."""
    return _environment.get_template(template).render(**content)


def mark_of(word: str | None) -> str:
    """The colour's name of a verdict or state."""
    return _MARKS.get(word or "", "plain")


@dataclass(frozen=True)
class JobView:
    """A job as a page shows it.

    Attributes:
        id, kind: of the job.
        result: verdict, or else state.
        mark: colour's name of the result.
        created, took: times in words.
        stage: what it does.
        error: why it failed.
        is_finished: whether nothing will change.
    """

    id: str
    kind: str
    result: str
    mark: str
    created: str
    took: str
    stage: str
    error: str | None
    is_finished: bool


def job_view(record: JobRecord, step: Step | None) -> JobView:
    """A job as a page shows it."""
    result = "CANNOT TELL" if record.cannot_tell else record.verdict or record.state
    took = ""
    if record.started_s is not None and record.finished_s is not None:
        took = _in_words(record.finished_s - record.started_s)
    return JobView(
        id=record.id,
        kind=record.kind,
        result=result,
        mark=mark_of(result),
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
    """A camera's row.

    Attributes:
        name: of the camera.
        verdict, mark: of it, and its colour's name.
        numbers: in the order of the columns.
    """

    name: str
    verdict: str
    mark: str
    numbers: tuple[str, ...]


def camera_table(cameras: Mapping[str, Any]) -> tuple[list[str], list[CameraView]]:
    """Names of the columns, and a row per camera, of a result's or an audit's ``cameras``."""
    is_audit = any("status" in camera for camera in cameras.values())
    rows = _AUDITED if is_audit else _SOLVED
    views = [_camera_view(name, camera, rows) for name, camera in cameras.items()]
    return [title for title, _, _ in rows], views


def _camera_view(name: str, camera: Mapping[str, Any], rows: Sequence[_Row]) -> CameraView:
    verdict = str(camera.get("status") or camera.get("verdict"))
    verdict = "CANNOT TELL" if camera.get("cannot_tell") else verdict
    numbers = tuple(_numbers(camera, path, form) for _, path, form in rows)
    return CameraView(name, verdict, mark_of(verdict), numbers)


def _numbers(camera: Mapping[str, Any], path: str, form: str) -> str:
    """One number, or those of the axes; a dash where there is none."""
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


def reasons_of(summary: Mapping[str, Any]) -> list[str]:
    """Why a result is not PASS, or a check not OK."""
    cameras: Mapping[str, Mapping[str, Any]] = summary.get("cameras", {})
    audit = [f"{name}: {c['reason']}" for name, c in cameras.items() if c.get("reason")]
    return [*summary.get("reasons", []), *audit]
