"""The content of the pages for people: results and trackers in words and numbers."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibgraph.report.kit import load_template
from calibgraph.service.answers import utc

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


def render(template: str, **content: object) -> str:
    """A page of ``pages/``; all text in it is escaped."""
    in_words = {"minute_of": minute_of, "duration_of": duration_of}
    page = load_template(template, "calibgraph.service", "pages")
    return page.render(**in_words, **content)


def minute_of(time_s: float) -> str:
    """A time since 1970 in words."""
    return f"{utc(time_s):%Y-%m-%d %H:%M} UTC"


def duration_of(seconds: float) -> str:
    """A duration in words."""
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
