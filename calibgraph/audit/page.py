"""The page of an audit: is the deployed calibration still right?"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.audit.page_camera import camera_sections
from calibgraph.audit.result import Audit, twist_cells
from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.summary import Reason
from calibgraph.report.kit import load_template
from calibgraph.report.page_overlays import depth_scale

_CALIBRATE = (
    "Do not use it any longer. Fasten what is loose, and calibrate again: calibgraph calibrate. If "
    "nothing can have moved, check the intrinsics and the distances of the LiDAR: where these have "
    "changed, it looks like a motion."
)
_RECORD = (
    "Record again, and check that: 30 frames or more, at different places, with walls, poles and "
    "vehicles near and far, and all over the image. The reasons name what is missing."
)


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
        answer=_answer(audit),
        reasons=_reasons(audit),
        advice=_advice(audit),
        detectable=_detectable(audit),
        lidar=_lidar(audit),
        tolerance=twist_cells(_tolerance(audit), ".2f"),
        depth_scale=depth_scale(),
        frames_sentence=FRAMES_SENTENCE,
    )


def _answer(audit: Audit) -> str:
    """Is it still right? In a sentence or two."""
    unknown = [name for name, camera in audit.cameras.items() if camera.status == "CANNOT TELL"]
    if audit.status == "OK":
        return "Yes. No axis of any camera deviates by more than the tolerance."
    if audit.status == "CANNOT TELL":
        return (
            f"This recording cannot tell for {', '.join(unknown)}. Nothing was found to be wrong."
        )
    verb, them = ("is", "it") if len(audit.wrong) == 1 else ("are", "them")
    wrong = f"No. {', '.join(audit.wrong)} {verb} not where the calibration has {them}."
    return f"{wrong} For {', '.join(unknown)} this recording cannot tell." if unknown else wrong


def _reasons(audit: Audit) -> list[Reason]:
    """The findings of the LiDAR and of each camera; the same of several is one line."""
    alike: dict[tuple[str, str], tuple[str, ...]] = {}
    if audit.lidar is not None:
        alike["WRONG", f"{audit.lidar.reason}; all cameras agree on it"] = ("LiDAR",)
    for name, camera in audit.cameras.items():
        key = camera.status, camera.reason
        alike[key] = (*alike.get(key, ()), name)
    return [Reason(status, names, text) for (status, text), names in alike.items()]


def _advice(audit: Audit) -> list[str]:
    """Advice by status: calibrate again, record again, or nothing."""
    statuses = {camera.status for camera in audit.cameras.values()}
    wrong = [_CALIBRATE] if "WRONG" in statuses else []
    unknown = [_RECORD] if "CANNOT TELL" in statuses else []
    return wrong + unknown or ["Nothing: keep it in use."]


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


def _tolerance(audit: Audit) -> NDArray[np.float64]:
    """(6,) rotation [rad], translation [m]."""
    degrees, centimetres = audit.tolerance_deg, audit.tolerance_cm
    return np.repeat([np.radians(degrees), centimetres / 100], 3)


def _lidar(audit: Audit) -> list[tuple[str, list[str]]]:
    """The rows of the table of the LiDAR's motion; none if it is not named."""
    if audit.lidar is None:
        return []
    of = audit.lidar
    return [("motion", twist_cells(of.motion, "+z.2f")), ("sigma", twist_cells(of.sigma, ".2f"))]
