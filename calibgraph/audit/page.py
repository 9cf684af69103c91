"""An audit for people: tables for a terminal, and a page with the cloud on an image per camera."""

from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import gtsam
import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from calibgraph.audit.drift import Drift
from calibgraph.audit.result import Audit, CameraAudit, twist_cells
from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.rig import Camera
from calibgraph.model.summary import Reason
from calibgraph.report.kit import page_template
from calibgraph.report.pictures import depth_scale, draw_overlays, width_on_page
from calibgraph.report.tables import make_table


def write_audit_report(audit: Audit, path: Path | str) -> Path:
    """Write an audit as one HTML page that needs nothing else; returns its path.

    Images and the cloud are read from the recording; if they cannot be read, the page names the
    cause and leaves the pictures out.

    Raises:
        FileError: if the page cannot be written.
    """
    measured = {name: measured_camera(audit.deployed.cameras[name], camera)
                for name, camera in audit.cameras.items()}  # fmt: skip
    cameras = {name: [each for each in (camera, measured[name]) if each is not None]
               for name, camera in audit.deployed.cameras.items()}  # fmt: skip
    overlays, left_out = draw_overlays(audit.shown, cameras)
    page = page_template("calibgraph.audit").render(
        audit=audit,
        date=datetime.now(UTC).date().isoformat(),
        measured=measured,
        overlays=overlays,
        overlays_left_out=left_out,
        reasons=_reasons(audit),
        twist_cells=twist_cells,
        width_on_page=width_on_page,
        depth_scale=depth_scale(),
        frames_sentence=FRAMES_SENTENCE,
    )
    write_text(Path(path), page)
    return Path(path)


def _reasons(audit: Audit) -> list[Reason]:
    """The findings of the LiDAR and of each camera, the worst first; the same of several is one."""
    alike: dict[tuple[str, str], tuple[str, ...]] = {}
    if audit.lidar is not None:
        alike["WRONG", audit.lidar_reason] = audit.wrong
    for name, camera in audit.sensors.items():
        key = camera.status, camera.reason
        alike[key] = (*alike.get(key, ()), name)
    reasons = [Reason(status, names, text) for (status, text), names in alike.items()]
    return sorted(reasons, key=lambda reason: ("WRONG", "CANNOT TELL", "OK").index(reason.status))


def measured_camera(deployed: Camera, audit: CameraAudit) -> Camera | None:
    """The camera where it was measured; None if nothing was measured."""
    if audit.deviation is None:
        return None
    T_now_deployed = gtsam.Pose3.Expmap(-audit.deviation).matrix()
    return deployed.moved_to(np.asarray(T_now_deployed @ deployed.T_camera_lidar))


_COLOURS = {"OK": "green", "CANNOT TELL": "yellow", "WRONG": "red", "CHANGED": "red"}


def print_audit(console: Console, audit: Audit, page: Path | None, elapsed_s: float) -> None:
    """Print the status with its reasons, the deviations per axis, and what was written."""
    lines = [f"WRONG {audit.wrong[0]}: {audit.lidar_reason}"] if audit.lidar is not None else []
    lines += [f"{sensor.status} {name}: {sensor.reason}" for name, sensor in audit.sensors.items()]
    lines += filter(None, (audit.same_recording_note, audit.deployed_verdict_note))
    _print_status(console, audit.status, "check: is the deployed calibration still right?", lines)
    console.print(audit_table(audit))
    console.print(
        "deviation: motion of the camera from where it is deployed, about and along its own axes; "
        "sigma: its standard deviation; detectable: the smallest change that is told from none, "
        "with 90 % probability at 95 % confidence; changed intrinsics, and distances in the clouds "
        "that are all too long or too short, look like a motion"
    )
    written = "nothing was written" if page is None else f"{page}: written"
    end = f"{audit.frames} frames; {elapsed_s:.1f} s; {written}"
    console.out(f"{_tolerance(audit)}; {end}", highlight=False)


def print_drift(console: Console, drift: Drift) -> None:
    """Print the status with its reasons, the deviations and what would have been detected."""
    lines = [drift.same_recording_note] if drift.same_recording else []
    question = "drift: does one of the results deviate from the others?"
    _print_status(console, drift.status, question, [*lines, *_drift_lines(drift)])
    console.print(drift_table(drift))
    console.print(
        "deviation: motion of the camera from where the other results place it, about and along "
        "its own axes; detectable: what would have been seen with 90 % probability. Errors that "
        "all results share cancel, but are part of the sigmas: the test is conservative"
    )
    rate = f"{drift.false_alarm_rate:.0%}"
    console.out(f"{_tolerance(drift)}; false alarms of at most {rate} per call", highlight=False)


def _print_status(console: Console, status: str, question: str, lines: Iterable[str]) -> None:
    coloured = f"[bold {_COLOURS[status]}]{status}[/]"
    console.print(f"{coloured}  {question}", highlight=False, soft_wrap=True)
    for line in lines:
        console.out(f"  {line}", highlight=False)


def _tolerance(of: Audit | Drift) -> str:
    return f"tolerance {of.tolerance_deg:g} deg, {of.tolerance_cm:g} cm"


def audit_table(audit: Audit) -> Table:
    """Three rows per camera: deviation, sigma, smallest detectable change."""
    rows = []
    for name, camera in audit.sensors.items():
        rows.append([name, "deviation", *twist_cells(camera.deviation, 2, "+z")])
        rows.append(["", "sigma", *twist_cells(camera.sigma, 2)])
        rows.append(["", "detectable", *twist_cells(camera.detectable, 2)])
    return make_table("Deviation from the deployed calibration", rows, words=("",))


def _drift_lines(drift: Drift) -> list[str]:
    """A line per camera and result, and per LiDAR that stands out; OK ones together."""
    base, others = ("base LiDAR", "other sensors") if drift.lidars else ("LiDAR", "cameras")
    lines = [
        f"CHANGED {result}, {base}: {lidar.reason}; all {others} agree on it"
        for result, lidar in zip(drift.results, drift.lidar, strict=True)
        if lidar is not None
    ]
    lines += [
        f"{each.status} {result}, {name}: {each.reason}"
        for name, entries in drift.cameras.items()
        for result, each in zip(drift.results, entries, strict=True)
        if each.status != "OK" or "significant:" in each.reason
    ]
    return lines


def drift_table(drift: Drift) -> Table:
    """Two rows per camera and result, the deviation and the detectable one."""
    rows = []
    for name, entries in drift.cameras.items():
        for row, (result, each) in enumerate(zip(drift.results, entries, strict=True)):
            status = f"[{_COLOURS[each.status]}]{each.status}[/]"
            cells = twist_cells(each.deviation, 2, "+")
            rows.append(["" if row else name, escape(result), status, *cells])
            rows.append(["", "", "detectable", *twist_cells(each.detectable, 2)])
    names = ("camera", "result")
    return make_table("Deviation from the other results", rows, names=names, words=("",))
