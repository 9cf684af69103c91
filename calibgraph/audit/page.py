"""The page of an audit: is the deployed calibration still right?"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibgraph.audit.page_camera import camera_sections
from calibgraph.audit.result import Audit, twist_cells
from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.summary import Reason
from calibgraph.report.kit import load_template
from calibgraph.report.page_overlays import depth_scale
from calibgraph.report.worked_point import matrix_text


def write_audit_report(audit: Audit, path: Path | str) -> Path:
    """Write an audit as one HTML page that needs nothing else: no network, no files beside it.

    Images and the cloud are read from the recording; if they cannot be read, the page names the
    cause and leaves the pictures out.

    Args:
        audit: of :func:`calibgraph.check`.
        path: of the page.

    Returns:
        The path.

    Raises:
        FileError: if the page cannot be written.
    """
    path = Path(path)
    write_text(path, audit_html(audit))
    return path


def audit_html(audit: Audit) -> str:
    """The page as text; see :func:`write_audit_report`."""
    cameras, left_out = camera_sections(audit)
    return load_template("page.html.j2", "calibgraph.audit").render(
        audit=audit,
        date=datetime.now(UTC).date().isoformat(),
        cameras=cameras,
        pictures_left_out=left_out,
        reasons=_reasons(audit),
        detectable=_detectable(audit),
        twist_cells=twist_cells,
        matrix_text=matrix_text,
        depth_scale=depth_scale(),
        frames_sentence=FRAMES_SENTENCE,
    )


def _reasons(audit: Audit) -> list[Reason]:
    """The findings of the LiDAR and of each camera; the same of several is one line."""
    alike: dict[tuple[str, str], tuple[str, ...]] = {}
    if audit.lidar is not None:
        alike["WRONG", f"{audit.lidar.reason}; all cameras agree on it"] = ("LiDAR",)
    for name, camera in audit.cameras.items():
        key = camera.status, camera.reason
        alike[key] = (*alike.get(key, ()), name)
    return [Reason(status, names, text) for (status, text), names in alike.items()]


def _detectable(audit: Audit) -> str:
    """The smallest detectable change over all cameras."""
    known = [c.detectable for c in audit.cameras.values() if c.detectable is not None]
    missing = [name for name, c in audit.cameras.items() if c.detectable is None]
    sentences = []
    if known:
        worst = np.max(known, axis=0)
        degrees, centimetres = np.degrees(worst[:3]).max(), 100 * worst[3:].max()
        sentences += [
            f"With a probability of 90 %, a turn of any camera about an axis by {degrees:.2f} deg, "
            f"or a shift along one by {centimetres:.1f} cm."
        ]
    if missing:
        sentences += [f"Unknown for {', '.join(missing)}."]
    return " ".join(sentences)
