"""The page's bar charts: deviations with their error bars, the tolerance, what was detectable.

Lengths are in units of the drawing, 380 wide, which is about its pixels on a phone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.audit.result import CameraAudit

Array = NDArray[np.float64]

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
        title: what it is of, and the unit.
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
