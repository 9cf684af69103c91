"""The page of an audit: is the deployed calibration still right?

Per camera: numbers, the cloud on an image.
"""

from datetime import UTC, datetime
from pathlib import Path

import gtsam
import numpy as np

from calibgraph.audit.result import Audit, CameraAudit, twist_cells
from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.rig import Camera
from calibgraph.model.summary import Reason
from calibgraph.report.kit import page_template
from calibgraph.report.page_overlays import depth_scale, draw_overlays, width_on_page


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
        alike["WRONG", f"{audit.lidar.reason}; all cameras agree on it"] = ("LiDAR",)
    for name, camera in audit.cameras.items():
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
