"""One camera's section of an audit page: numbers, charts, points on an image."""

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.audit.result import Audit, CameraAudit
from calibgraph.errors import CalibrationError
from calibgraph.model.rig import Camera
from calibgraph.report.page_overlays import PICTURES_BYTES, draw_by_depth, width_on_page

# The charts: lengths in units of the drawing, 380 wide, which is about its pixels on a phone.
_LEFT, _RIGHT = 74.0, 284.0  # of the axis: names to its left, numbers to its right
_MIDDLE, _HALF = (_LEFT + _RIGHT) / 2, (_RIGHT - _LEFT) / 2
_TOP, _ROW = 18.0, 30.0
_MARGIN = 1.08  # of the axis beyond the largest value
_MOST_TICKS = 2  # on each side
_PARTS = (
    ("rotation", "deg", slice(0, 3), 180 / np.pi, ("x (pitch)", "y (yaw)", "z (roll)")),
    ("translation", "cm", slice(3, 6), 100.0, ("x (right)", "y (down)", "z (ahead)")),
)


@dataclass(frozen=True)
class Bar:
    """An axis of a camera, from the middle of the drawing to its deviation.

    Attributes:
        name: of the axis.
        y: of its middle.
        x: of its left end.
        width: of it.
        error: ends of the error bar, one sigma to either side; None if unknown.
        detectable: where the smallest detectable changes are; empty if unknown.
        style: ``within``, ``beyond`` the tolerance, or ``unsure`` where the data cannot tell.
        text: the deviation and its sigma.
    """

    name: str
    y: float
    x: float
    width: float
    error: tuple[float, float] | None
    detectable: tuple[float, ...]
    style: str
    text: str


@dataclass(frozen=True)
class Chart:
    """The rotations or the translations of a camera.

    Attributes:
        title: rotation or translation, and the unit.
        bars: three.
        tolerance: left and right end of the band of the tolerance.
        ticks: x and label of the axis' marks.
        bottom: y of the axis.
        left, right: its ends.
        middle: the x of no deviation.
    """

    title: str
    bars: tuple[Bar, ...]
    tolerance: tuple[float, float]
    ticks: tuple[tuple[float, str], ...]
    bottom: float
    left: float = _LEFT
    right: float = _RIGHT
    middle: float = _MIDDLE


def charts_of(camera: CameraAudit, tolerance_deg: float, tolerance_cm: float) -> tuple[Chart, ...]:
    """The rotations and the translations of a camera; none where nothing was measured."""
    if camera.deviation is None:
        return ()
    return tuple(
        _chart(camera, part, tolerance)
        for part, tolerance in zip(_PARTS, (tolerance_deg, tolerance_cm), strict=True)
    )


def _chart(
    camera: CameraAudit, part: tuple[str, str, slice, float, tuple[str, ...]], tolerance: float
) -> Chart:
    title, unit, rows, factor, names = part
    values = np.stack(
        [
            np.full(3, np.nan) if twist is None else twist[rows] * factor
            for twist in (camera.deviation, camera.sigma, camera.detectable)
        ],
        axis=1,
    )  # of each axis: deviation, sigma, detectable
    ends = np.abs(values[:, 0]) + np.nan_to_num(values[:, 1])
    reach = _MARGIN * float(np.nanmax([*ends, *values[:, 2], tolerance]))
    band = tolerance * _HALF / reach
    return Chart(
        title=f"{title} [{unit}]",
        bars=tuple(
            _bar(name, k, values[k], reach, style=_style(camera, values[k, 0], tolerance))
            for k, name in enumerate(names)
        ),
        tolerance=(_MIDDLE - band, _MIDDLE + band),
        ticks=_ticks(reach),
        bottom=_TOP + _ROW * len(names),
    )


def _style(camera: CameraAudit, deviation: float, tolerance: float) -> str:
    if camera.status == "CANNOT TELL":
        return "unsure"
    return "beyond" if abs(deviation) > tolerance else "within"


def _bar(name: str, row: int, values: Array, reach: float, *, style: str) -> Bar:
    """The bar of an axis."""
    deviation, sigma, detectable = values * _HALF / reach
    x, known = _MIDDLE + deviation, bool(np.isfinite(sigma))
    return Bar(
        name=name,
        y=_TOP + _ROW * (row + 0.5),
        x=min(x, _MIDDLE),
        width=abs(deviation),
        error=(x - sigma, x + sigma) if known else None,
        detectable=(_MIDDLE - detectable, _MIDDLE + detectable) if known else (),
        style=style,
        text=f"{values[0]:+z.2f}" + (f" \u00b1 {values[1]:.2f}" if known else ""),
    )


def _ticks(reach: float) -> tuple[tuple[float, str], ...]:
    """Marks at round numbers, at most two on each side of the middle."""
    smallest = reach / (_MOST_TICKS + 1)
    decade = 10.0 ** math.floor(math.log10(smallest))
    step = next(decade * m for m in (1, 2, 5, 10) if decade * m > smallest)
    marks = range(-int(reach / step), int(reach / step) + 1)
    return tuple((_MIDDLE + k * step * _HALF / reach, f"{k * step:g}") for k in marks)


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
        charts: rotations and translations; none where nothing was measured.
        pictures: None if they cannot be drawn.
        deployed, measured: the camera; None if it is not known, or nothing was measured.
    """

    name: str
    anchor: str
    audit: CameraAudit
    charts: tuple[Chart, ...]
    pictures: Pictures | None
    deployed: Camera | None
    measured: Camera | None


def camera_sections(audit: Audit) -> tuple[list[Section], str | None]:
    """The sections of all cameras; the reason why pictures are missing, None if none are."""
    pictures, left_out = _draw(audit)
    cameras = {} if audit.deployed is None else audit.deployed.cameras
    sections = []
    for number, (name, camera) in enumerate(audit.cameras.items()):
        deployed = cameras.get(name)
        sections.append(
            Section(
                name=name,
                anchor=f"camera-{number}",
                audit=camera,
                charts=charts_of(camera, audit.tolerance_deg, audit.tolerance_cm),
                pictures=pictures.get(name),
                deployed=deployed,
                measured=None if deployed is None else measured_camera(deployed, camera),
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
