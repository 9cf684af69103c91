"""The content of the pages for people: results and trackers in words and numbers."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from calibgraph.report.kit import load_template
from calibgraph.service.answers import utc

_MINUTE_S = 60


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
