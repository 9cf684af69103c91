"""An audit as a table for a terminal, in degrees and centimetres."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.audit import Audit, CameraAudit
from calibgraph.audit.result import twist_cells
from calibgraph.cli.tables import CAMERA_AXES_COLUMNS, add_number_columns, empty_table
from calibgraph.cli.terminal import print_plain

_QUESTION = "check: is the deployed calibration still right?"
_SAME = "; this recording made it, and errors that it repeats are not seen: check another one"
_COLOURS = {"OK": "green", "CANNOT TELL": "yellow", "WRONG": "red"}


def print_audit(console: Console, audit: Audit, page: Path | None = None) -> None:
    """Print the status with its reasons, the deviations per axis, and what was written."""
    same = _SAME if audit.same_recording else ""
    status = f"[bold {_COLOURS[audit.status]}]{audit.status}[/]"
    console.print(f"{status}  {_QUESTION}{same}", highlight=False, soft_wrap=True)
    if audit.lidar is not None:
        print_plain(console, f"  WRONG LiDAR: {audit.lidar.reason}; all cameras agree on it")
    for name, camera in audit.cameras.items():
        print_plain(console, f"  {camera.status} {name}: {camera.reason}")
    console.print(audit_table(audit))
    console.print(
        "deviation: motion of the camera from where it is deployed, about and along its own axes; "
        "sigma: its standard deviation; detectable: the smallest change that is told from none, "
        "with 90 % probability at 95 % confidence; changed intrinsics, and distances in the clouds "
        "that are all too long or too short, look like a motion"
    )
    time = f"{sum(audit.timings_s.values()):.1f} s"
    text = f"tolerance {audit.tolerance_deg:g} deg, {audit.tolerance_cm:g} cm per axis"
    written = "nothing was written" if page is None else f"{page}: written"
    print_plain(console, f"{text}; {audit.frames} frames; {time}; {written}")


def audit_table(audit: Audit) -> Table:
    """Three rows per camera: deviation, sigma, smallest detectable change."""
    table = empty_table("Deviation from the deployed calibration", "camera", "")
    add_number_columns(table, *CAMERA_AXES_COLUMNS)
    for name, camera in audit.cameras.items():
        for row, (label, cells) in enumerate(_rows(camera)):
            table.add_row("" if row else escape(name), label, *cells)
    return table


def _rows(camera: CameraAudit) -> list[tuple[str, list[str]]]:
    rows = (
        ("deviation", camera.deviation, "+z.2f"),
        ("sigma", camera.sigma, ".2f"),
        ("detectable", camera.detectable, ".2f"),
    )
    return [(label, twist_cells(twist, form)) for label, twist, form in rows]
