"""An audit, and a comparison of results, as tables for a terminal, in degrees and centimetres."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.audit import Audit, Drift
from calibgraph.audit.result import twist_cells
from calibgraph.cli.tables import CAMERA_AXES_COLUMNS, add_number_columns, empty_table
from calibgraph.cli.terminal import elapsed_s, print_plain

_COLOURS = {"OK": "green", "CANNOT TELL": "yellow", "WRONG": "red", "CHANGED": "red"}


def print_audit(console: Console, audit: Audit, page: Path | None = None) -> None:
    """Print the status with its reasons, the deviations per axis, and what was written."""
    _print_status(console, audit.status, "check: is the deployed calibration still right?")
    if audit.lidar is not None:
        print_plain(console, f"  WRONG LiDAR: {audit.lidar.reason}; all cameras agree on it")
    for name, camera in audit.cameras.items():
        print_plain(console, f"  {camera.status} {name}: {camera.reason}")
    for note in filter(None, (audit.same_recording_note, audit.deployed_verdict_note)):
        print_plain(console, f"  {note}")
    console.print(audit_table(audit))
    console.print(
        "deviation: motion of the camera from where it is deployed, about and along its own axes; "
        "sigma: its standard deviation; detectable: the smallest change that is told from none, "
        "with 90 % probability at 95 % confidence; changed intrinsics, and distances in the clouds "
        "that are all too long or too short, look like a motion"
    )
    written = "nothing was written" if page is None else f"{page}: written"
    print_plain(
        console, f"{_tolerance(audit)}; {audit.frames} frames; {elapsed_s():.1f} s; {written}"
    )


def print_drift(console: Console, drift: Drift) -> None:
    """Print the status with its reasons, the deviations and what would have been detected."""
    _print_status(console, drift.status, "drift: does one of the results deviate from the others?")
    if drift.same_recording:
        print_plain(console, f"  {drift.same_recording_note}")
    for line in _reasons(drift):
        print_plain(console, f"  {line}")
    console.print(_deviation_table(drift))
    console.print(_detectable_table(drift))
    console.print(
        "deviation: motion of the camera from where the other results place it, about and along "
        "its own axes; detectable: what would have been seen with 90 % probability. Errors that "
        "all results share cancel, but are part of the sigmas: the test is conservative"
    )
    rate = f"{drift.false_alarm_rate:.0%}"
    print_plain(console, f"{_tolerance(drift)}; false alarms of at most {rate} per call")


def _print_status(console: Console, status: str, question: str) -> None:
    console.print(
        f"[bold {_COLOURS[status]}]{status}[/]  {question}", highlight=False, soft_wrap=True
    )


def _tolerance(of: Audit | Drift) -> str:
    return f"tolerance {of.tolerance_deg:g} deg, {of.tolerance_cm:g} cm"


def _axes_table(title: str, *names: str, words: tuple[str, ...] = ()) -> Table:
    """An empty table with a number per axis of a camera behind its names."""
    table = empty_table(title, *names, words=words)
    add_number_columns(table, *CAMERA_AXES_COLUMNS)
    return table


def audit_table(audit: Audit) -> Table:
    """Three rows per camera: deviation, sigma, smallest detectable change."""
    table = _axes_table("Deviation from the deployed calibration", "camera", words=("",))
    for name, camera in audit.cameras.items():
        table.add_row(escape(name), "deviation", *twist_cells(camera.deviation, 2, "+z"))
        table.add_row("", "sigma", *twist_cells(camera.sigma, 2))
        table.add_row("", "detectable", *twist_cells(camera.detectable, 2))
    return table


def _reasons(drift: Drift) -> list[str]:
    """A line per camera and result, and per trend and LiDAR that stands out; OK ones together."""
    lines = [f"CHANGED {result}, LiDAR: {lidar.reason}; all cameras agree on it"
             for result, lidar in zip(drift.results, drift.lidar, strict=True)
             if lidar is not None]  # fmt: skip
    lines += [
        f"CHANGED {name}, trend: {trend.reason}"
        for name, trend in drift.trends.items()
        if trend.changed
    ]
    for name, entries in drift.cameras.items():
        for result, each in zip(drift.results, entries, strict=True):
            if each.status != "OK" or "significant:" in each.reason:
                lines.append(f"{each.status} {result}, {name}: {each.reason}")
    return lines


def _deviation_table(drift: Drift) -> Table:
    """A row per camera and result, and one for the trend."""
    table = _axes_table("Deviation from the other results", "camera", "result", words=("",))
    for name, entries in drift.cameras.items():
        for row, (result, each) in enumerate(zip(drift.results, entries, strict=True)):
            status = f"[{_COLOURS[each.status]}]{each.status}[/]"
            cells = twist_cells(each.deviation, 2, "+")
            table.add_row("" if row else escape(name), escape(result), status, *cells)
        trend = drift.trends.get(name)
        if trend is not None:
            table.add_row("", "trend", f"per {trend.unit}", *twist_cells(trend.slope, 3, "+"))
            table.add_row("", "sigma", "", *twist_cells(trend.sigma, 3))
    return table


def _detectable_table(drift: Drift) -> Table:
    """A row per camera and result."""
    table = _axes_table("Smallest detectable change", "camera", "result")
    for name, entries in drift.cameras.items():
        for row, (result, each) in enumerate(zip(drift.results, entries, strict=True)):
            cells = twist_cells(each.detectable, 2)
            table.add_row("" if row else escape(name), escape(result), *cells)
    return table
