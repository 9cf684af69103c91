"""The page of an audit: is the deployed calibration still right?

Per camera: numbers, charts, the cloud on an image.
"""

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import gtsam
import numpy as np

from calibgraph.audit.judgement import CAMERA_AXES
from calibgraph.audit.result import Audit, CameraAudit, twist_cells
from calibgraph.audit.significance import DISPLAY
from calibgraph.errors import CalibrationError
from calibgraph.files import write_text
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.clock import when_taken
from calibgraph.model.rig import Camera
from calibgraph.model.summary import Reason
from calibgraph.report.camera_section import matrix_text
from calibgraph.report.kit import load_template
from calibgraph.report.page_overlays import (
    PICTURES_BYTES,
    depth_scale,
    draw_by_depth,
    width_on_page,
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
        reasons=_reasons(audit),
        detectable=_detectable(audit),
        twist_cells=twist_cells,
        matrix_text=matrix_text,
        depth_scale=depth_scale(),
        frames_sentence=FRAMES_SENTENCE,
    )


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


_MIDDLE, _HALF = 179.0, 105.0
"""Of a chart's axis, in units of the drawing, 380 wide: about its pixels on a phone."""
_MARGIN = 1.08  # of the axis beyond the largest value
_MOST_TICKS = 2  # on each side


@dataclass(frozen=True)
class Bar:
    """An axis of a camera in degrees or centimetres; sigma and detectable are NaN if unknown.

    The style is ``within``, ``beyond`` the tolerance, or ``unsure`` where the data cannot tell.
    """

    name: str
    deviation: float
    sigma: float
    detectable: float
    style: str

    @property
    def has_error(self) -> bool:
        """Whether its error is known."""
        return math.isfinite(self.sigma)

    @property
    def text(self) -> str:
        """The deviation and its sigma."""
        return f"{self.deviation:+z.2f}" + f" \u00b1 {self.sigma:.2f}" * self.has_error


@dataclass(frozen=True)
class Chart:
    """The rotations or the translations of a camera, three bars, and what is tolerated."""

    title: str
    bars: tuple[Bar, ...]
    tolerance: float

    @property
    def reach(self) -> float:
        """The value at the ends of the axis."""
        ends = [abs(bar.deviation) + np.nan_to_num(bar.sigma) for bar in self.bars]
        limits = [bar.detectable for bar in self.bars]
        return _MARGIN * float(np.nanmax([*ends, *limits, self.tolerance]))

    def x(self, value: float) -> float:
        """Where a value is in the drawing."""
        return _MIDDLE + _HALF * value / self.reach

    @property
    def ticks(self) -> list[float]:
        """Marks at round numbers, at most two on each side of the middle."""
        smallest = self.reach / (_MOST_TICKS + 1)
        decade = 10.0 ** math.floor(math.log10(smallest))
        step = next(decade * m for m in (1, 2, 5, 10) if decade * m > smallest)
        most = int(self.reach / step)
        return [k * step for k in range(-most, most + 1)]


def charts_of(camera: CameraAudit, tolerance_deg: float, tolerance_cm: float) -> tuple[Chart, ...]:
    """The rotations and the translations of a camera; none where nothing was measured."""
    if camera.deviation is None:
        return ()
    twists = (camera.deviation, camera.sigma, camera.detectable)
    rows = np.stack([np.full(6, np.nan) if t is None else t * DISPLAY for t in twists], axis=1)
    parts = (
        (slice(0, 3), "rotation", "deg", tolerance_deg),
        (slice(3, 6), "translation", "cm", tolerance_cm),
    )
    charts = []
    for part, word, unit, tolerance in parts:
        total = float(np.linalg.norm(rows[part, 0]))
        style = "beyond" if total > tolerance else "within"
        style = "unsure" if camera.status == "CANNOT TELL" else style
        bars = (
            Bar(name, deviation, sigma, detectable, style)
            for name, (deviation, sigma, detectable) in zip(
                CAMERA_AXES[part], rows[part].tolist(), strict=True
            )
        )
        charts.append(Chart(f"{word} [{unit}], {total:.2f} in all", tuple(bars), tolerance))
    return tuple(charts)


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
        charts: rotations and translations; none where nothing was measured.
        pictures: None if they cannot be drawn.
        deployed, measured: the camera; None if nothing was measured.
    """

    name: str
    anchor: str
    audit: CameraAudit
    charts: tuple[Chart, ...]
    pictures: Pictures | None
    deployed: Camera
    measured: Camera | None


def camera_sections(audit: Audit) -> tuple[list[Section], str | None]:
    """The sections of all cameras; the reason why pictures are missing, None if none are."""
    pictures, left_out = _draw(audit)
    sections = []
    for number, (name, camera) in enumerate(audit.cameras.items()):
        deployed = audit.deployed.cameras[name]
        sections.append(
            Section(
                name=name,
                anchor=f"camera-{number}",
                audit=camera,
                charts=charts_of(camera, audit.tolerance_deg, audit.tolerance_cm),
                pictures=pictures.get(name),
                deployed=deployed,
                measured=measured_camera(deployed, camera),
            )
        )
    return sections, left_out


def measured_camera(deployed: Camera, audit: CameraAudit) -> Camera | None:
    """The camera where it was measured; None if nothing was measured."""
    if audit.deviation is None:
        return None
    T_now_deployed = gtsam.Pose3.Expmap(-audit.deviation).matrix()
    return deployed.moved_to(np.asarray(T_now_deployed @ deployed.T_camera_lidar))


def _draw(audit: Audit) -> tuple[dict[str, Pictures], str | None]:
    """Per camera its pictures; the reason why the others are missing, None if none are."""
    drawn: dict[str, Pictures] = {}
    budget = PICTURES_BYTES // (2 * len(audit.cameras))
    try:
        cloud = audit.shown.load_cloud()[:, :3].astype(np.float64)
        for name, camera in audit.deployed.cameras.items():
            if name in audit.shown.image_paths:
                image = audit.shown.load_image(name, camera)
                measured = measured_camera(camera, audit.cameras[name])
                twist = audit.shown.twist_per_s
                seen = None if measured is None else when_taken(measured, twist)
                drawn[name] = Pictures(
                    draw_by_depth(image, cloud, when_taken(camera, twist), budget),
                    None if seen is None else draw_by_depth(image, cloud, seen, budget),
                    width_on_page(camera),
                )
    except (CalibrationError, OSError) as error:
        return drawn, str(error)
    return drawn, None
