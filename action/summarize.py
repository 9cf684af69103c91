"""The outputs, the summary in Markdown and the annotation of a check, for a GitHub runner.

python summarize.py EXIT_CODE JSON_FILE MESSAGES_FILE
"""

from __future__ import annotations

import html
import json
import os
import sys
from pathlib import Path
from typing import Any

AXES = ("pitch x deg", "yaw y deg", "roll z deg", "x right cm", "y down cm", "z ahead cm")
KINDS = {"OK": "notice", "CANNOT TELL": "warning", "WRONG": "error", "ERROR": "error"}
CHECKED = (0, 1, 3)  # exit codes with a result


def main() -> None:
    """Write all three."""
    code, found, messages = int(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3])
    if code in CHECKED:
        audit = json.loads(found.read_text("utf-8"))
        status, line = audit["status"], json.dumps(audit)
        reasons, summary = _reasons(audit), _summary(audit)
    else:
        status, line = "ERROR", ""
        reasons = [messages.read_text("utf-8").strip() or f"calibgraph ended with {code}"]
        summary = f"## Calibration: ERROR\n\n{_safe(reasons[0])}\n"
    _append("GITHUB_OUTPUT", f"status={status}\njson={line}\n")
    _append("GITHUB_STEP_SUMMARY", summary)
    print(f"::{KINDS[status]} title=calibgraph {status}::{_annotation('; '.join(reasons))}")


def _reasons(audit: dict[str, Any]) -> list[str]:
    """What is said of the LiDAR and of each camera."""
    lidar = audit["lidar"]
    of_lidar = [] if lidar is None else [f"LiDAR: {lidar['reason']}"]
    return of_lidar + [f"{name}: {camera['reason']}" for name, camera in audit["cameras"].items()]


def _summary(audit: dict[str, Any]) -> str:
    """A table in Markdown: a row per camera, deviation and sigma per axis."""
    tolerance = f"{audit['tolerance_deg']:g} deg, {audit['tolerance_cm']:g} cm per axis"
    lines = [
        f"## Calibration: {audit['status']}",
        "",
        f"{audit['frames']} frames; tolerance {tolerance}; deviation ± sigma, in camera axes.",
        "",
        _row(["camera", "", *AXES]),
        _row(["---"] * (2 + len(AXES))),
        *(_row([_safe(name), camera["status"], *_cells(camera)])
          for name, camera in audit["cameras"].items()),
        "",
        *(f"* {_safe(reason)}" for reason in _reasons(audit)),
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _cells(camera: dict[str, Any]) -> list[str]:
    deviations, sigmas = (
        [*(camera[f"{kind}_deg"] or [None] * 3), *(camera[f"{kind}_cm"] or [None] * 3)]
        for kind in ("deviation", "sigma")
    )
    return [
        "-" if d is None else f"{d:+.2f}" + ("" if s is None else f" ± {s:.2f}")
        for d, s in zip(deviations, sigmas, strict=True)
    ]


def _row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _safe(text: str) -> str:
    """Text of the user's files as Markdown that is neither a table's border nor HTML."""
    escaped = html.escape(" ".join(text.split()), quote=False)
    return "".join(f"\\{c}" if c in "|*_`[]" else c for c in escaped)


def _annotation(text: str) -> str:
    """Text of a workflow command, whose line it must not end."""
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _append(variable: str, text: str) -> None:
    with Path(os.environ[variable]).open("a", encoding="utf-8") as file:
        file.write(text)


if __name__ == "__main__":
    main()
