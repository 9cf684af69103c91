"""One camera's section of an audit page: numbers, charts, points on an image."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.audit.page_chart import Chart, charts_of
from calibgraph.audit.result import Audit, CameraAudit, twist_cells
from calibgraph.errors import CalibrationError
from calibgraph.model.rig import Camera
from calibgraph.report.page_overlays import PICTURES_BYTES, draw_by_depth, width_on_page
from calibgraph.report.worked_point import matrix_text


@dataclass(frozen=True)
class Pictures:
    """A cloud on an image of one camera, as data URIs.

    Attributes:
        deployed: by the deployed extrinsic.
        measured: by the measured one; None if nothing was measured.
        width_px: at most so wide they are shown.
    """

    deployed: str
    measured: str | None
    width_px: int


@dataclass(frozen=True)
class Section:
    """One camera's values for the template.

    Attributes:
        name: of the camera.
        anchor: of its section in the page.
        audit: of the camera.
        rows: label and six cells each: deviation, sigma, smallest detectable change.
        charts: rotations and translations; none where nothing was measured.
        pictures: None if they cannot be drawn.
        matrices: title and rows of T_camera_lidar, as deployed and as measured.
    """

    name: str
    anchor: str
    audit: CameraAudit
    rows: tuple[tuple[str, list[str]], ...]
    charts: tuple[Chart, ...]
    pictures: Pictures | None
    matrices: tuple[tuple[str, str], ...]


def camera_sections(audit: Audit) -> tuple[list[Section], str | None]:
    """The sections of all cameras; the reason why pictures are missing, None if none are."""
    pictures, left_out = _draw(audit)
    sections = [
        Section(
            name=name,
            anchor=f"camera-{number}",
            audit=camera,
            rows=_rows(camera),
            charts=charts_of(camera, audit.tolerance_deg, audit.tolerance_cm),
            pictures=pictures.get(name),
            matrices=_matrices(audit, name),
        )
        for number, (name, camera) in enumerate(audit.cameras.items())
    ]
    return sections, left_out


def measured_camera(deployed: Camera, audit: CameraAudit) -> Camera | None:
    """The camera where it was measured; None if nothing was measured."""
    if audit.deviation is None:
        return None
    T_now_deployed = gtsam.Pose3.Expmap(-audit.deviation).matrix()
    return deployed.moved_to(np.asarray(T_now_deployed @ deployed.T_camera_lidar))


def _rows(camera: CameraAudit) -> tuple[tuple[str, list[str]], ...]:
    return (
        ("deviation", twist_cells(camera.deviation, "+z.2f")),
        ("sigma", twist_cells(camera.sigma, ".2f")),
        ("detectable", twist_cells(camera.detectable, ".2f")),
    )


def _matrices(audit: Audit, name: str) -> tuple[tuple[str, str], ...]:
    if audit.deployed is None:
        return ()
    deployed = audit.deployed.cameras[name]
    measured = measured_camera(deployed, audit.cameras[name])
    both = (("as deployed", deployed), ("as measured", measured))
    return tuple(
        (title, matrix_text(camera.T_camera_lidar)) for title, camera in both if camera is not None
    )


def _draw(audit: Audit) -> tuple[dict[str, Pictures], str | None]:
    """Per camera its pictures; the reason why the others are missing, None if none are."""
    if audit.deployed is None or audit.shown is None:
        return {}, "the audit names no recording"
    drawn: dict[str, Pictures] = {}
    budget = PICTURES_BYTES // (2 * len(audit.cameras))
    try:
        cloud = audit.shown.load_cloud()[:, :3].astype(np.float64)
        for name, camera in audit.deployed.cameras.items():
            if name in audit.shown.image_paths:
                image = audit.shown.load_image(name, camera)
                measured = measured_camera(camera, audit.cameras[name])
                drawn[name] = Pictures(
                    draw_by_depth(image, cloud, camera, budget),
                    None if measured is None else draw_by_depth(image, cloud, measured, budget),
                    width_on_page(camera),
                )
    except (CalibrationError, OSError) as error:
        return drawn, str(error)
    return drawn, None
