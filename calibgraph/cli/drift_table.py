"""A comparison of results as tables for a terminal, in degrees and centimetres."""

from __future__ import annotations

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.audit import Drift
from calibgraph.audit.result import twist_cells
from calibgraph.cli.tables import CAMERA_AXES_COLUMNS, add_number_columns, empty_table
from calibgraph.cli.terminal import print_plain

_COLOURS = {"OK": "green", "CANNOT TELL": "yellow", "CHANGED": "red"}
_QUESTION = "drift: does one of the results deviate from the others?"
_LETTERS = 13  # of a result's name in a table; reasons have all of it


def print_drift(console: Console, drift: Drift) -> None:
    """Print the status with its reasons, the deviations and what would have been detected."""
    status = f"[bold {_COLOURS[drift.status]}]{drift.status}[/]"
    console.print(f"{status}  {_QUESTION}", highlight=False, soft_wrap=True)
    for line in _reasons(drift):
        print_plain(console, f"  {line}")
    console.print(_deviation_table(drift))
    console.print(_detectable_table(drift))
    console.print(
        "deviation: motion of the camera from where the other results place it, about and along "
        "its own axes; detectable: what would have been seen with 90 % probability. Errors that "
        "all results share cancel, but are part of the sigmas: the test is conservative"
    )
    text = f"tolerance {drift.tolerance_deg:g} deg, {drift.tolerance_cm:g} cm per axis"
    rate = f"{drift.false_alarm_rate:.0%}"
    print_plain(console, f"{text}; false alarms of at most {rate} per call")


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
    table = empty_table("Deviation from the other results", "camera", "result", "")
    add_number_columns(table, *CAMERA_AXES_COLUMNS)
    for name, entries in drift.cameras.items():
        for row, (result, each) in enumerate(zip(drift.results, entries, strict=True)):
            status = f"[{_COLOURS[each.status]}]{each.status}[/]"
            cells = twist_cells(each.deviation, "+.2f")
            table.add_row("" if row else escape(name), _short(result), status, *cells)
        trend = drift.trends.get(name)
        if trend is not None:
            table.add_row("", "trend", f"per {trend.unit}", *twist_cells(trend.slope, "+.3f"))
            table.add_row("", "sigma", "", *twist_cells(trend.sigma, ".3f"))
    return table


def _detectable_table(drift: Drift) -> Table:
    """A row per camera and result."""
    table = empty_table("Smallest detectable change", "camera", "result")
    add_number_columns(table, *CAMERA_AXES_COLUMNS)
    for name, entries in drift.cameras.items():
        for row, (result, each) in enumerate(zip(drift.results, entries, strict=True)):
            cells = twist_cells(each.detectable, ".2f")
            table.add_row("" if row else escape(name), _short(result), *cells)
    return table


def _short(name: str) -> str:
    """The end of a name that would leave no place for numbers on 80 columns."""
    return escape(name if len(name) <= _LETTERS else f"…{name[1 - _LETTERS :]}")
