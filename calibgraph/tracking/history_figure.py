"""The picture of a history: extrinsics against time with 3-sigma bands, and events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.report.figure import new_picture
from calibgraph.tracking.events import Event, Kind

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Colours that differ for the colour-blind too (Okabe and Ito, "Color universal design").
_AXES = {"x": "#0072B2", "y": "#E69F00", "z": "#009E73"}
_EVENTS: dict[Kind, str] = {
    "moved": "#D55E00",
    "drifts": "#A0408A",
    "blind": "#555555",
    "back": "#3399D0",
}
_INSTEAD = "#000000"
_POSE = 6

_WIDTH_IN, _ROW_IN, _FRAME_IN = 16.0, 2.5, 1.5
_NAME_LETTERS = 24
_LABELLED = 6  # events of a camera: more would hide each other; the legend has their colours
_SIGMAS = 3.0
_SURE = 3.0  # times the median sigma: an estimate with more does not set the scale
_SHOWN_PERCENT = (0.5, 99.5)
_MARGIN = 0.06
_HELD: Literal["steps-post"] = "steps-post"  # an estimate is valid until the next
_SMALLEST = 1e-3  # half of an axis' range, in its unit
_LARGE_NUMBER = 10**7  # frames with such numbers are counted from the first


@dataclass(frozen=True, eq=False)
class Curve:
    """One camera's extrinsic against time.

    Attributes:
        frames: (n,) numbers of frames, from its first own estimate to its newest.
        xi: (n, 6) of T_camera_lidar(frame) = exp(xi) T_camera_lidar(newest), xi = (rotation [rad],
            translation [m]) in the camera's axes. The last is zero.
        sigma: (n, 6) standard deviations of xi; NaN with too few frames.
    """

    frames: NDArray[np.int64]
    xi: Array
    sigma: Array


def text_figure(text: str) -> Figure:
    """A picture of one sentence."""
    figure = new_picture(_WIDTH_IN, _FRAME_IN + _ROW_IN)
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=14)
    return figure


def history_figure(
    curves: dict[str, Curve | None], events: Sequence[Event], first: int, newest: int
) -> Figure:
    """A row per camera: rotation and translation."""
    figure = new_picture(_WIDTH_IN, _FRAME_IN + _ROW_IN * len(curves))
    panels = figure.subplots(len(curves), len(_PARTS), sharex=True, squeeze=False)
    zero = first if newest >= _LARGE_NUMBER else 0
    for (name, curve), row in zip(curves.items(), panels, strict=True):
        own = [e for e in events if e.camera in (name, None) and e.kind != "started"]
        for panel, part in zip(row, _PARTS, strict=True):
            panel.set_xlim(first - zero, newest - zero)
            panel.set_ylabel(f"{_shortened(name)}\n{part.title}", parse_math=False)
            panel.grid(color="0.9", linewidth=0.8)
            _draw_events(panel, own, zero, newest)
            _draw_curve(panel, part, curve, zero)
    for panel in panels[-1]:
        panel.set_xlabel(f"frame number - {zero}" if zero else "frame number")
    figure.align_ylabels(panels)
    figure.suptitle(_title(first, newest), fontsize=12)
    legend = _legend({e.kind for e in events})
    figure.legend(
        handles=legend, loc="outside lower center", ncols=len(legend), frameon=False,
        columnspacing=1.4, handletextpad=0.5,
    )  # fmt: skip
    return figure


@dataclass(frozen=True)
class _Part:
    """A part of xi: its rows, what they are, and how many units one rad or m is."""

    rows: slice
    title: str
    units: float


_PARTS = (
    _Part(slice(0, 3), "rotation [deg]", float(np.degrees(1.0))),
    _Part(slice(3, 6), "translation [cm]", 100.0),
)


def _title(first: int, newest: int) -> str:
    return (
        f"Frames {first} to {newest}: T_camera_lidar less its newest estimate\n"
        "p_camera = T_camera_lidar * p_lidar, about and along the camera's axes"
    )


def _shortened(name: str) -> str:
    return name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"


def _draw_curve(panel: Axes, part: _Part, curve: Curve | None, zero: int) -> None:
    """Three lines in their bands."""
    if curve is None:
        panel.text(0.5, 0.5, "no estimate yet", ha="center", transform=panel.transAxes, color="0.4")
        panel.set_yticks([])
        return
    frames = curve.frames - zero
    xi, sigma = part.units * curve.xi[:, part.rows], part.units * curve.sigma[:, part.rows]
    colours = [*_AXES.values()] if len(xi.T) > 1 else [_INSTEAD]
    for value, deviation, colour in zip(xi.T, sigma.T, colours, strict=True):
        low, high = value - _SIGMAS * deviation, value + _SIGMAS * deviation
        panel.fill_between(frames, low, high, color=colour, alpha=0.17, linewidth=0, step="post")
        for edge in (low, high):  # so that overlapping bands can be distinguished
            panel.plot(frames, edge, color=colour, alpha=0.5, linewidth=0.6, drawstyle=_HELD)
    for value, colour in zip(xi.T, colours, strict=True):
        panel.plot(frames, value, color=colour, linewidth=1.4, drawstyle=_HELD)
    panel.set_ylim(*_limits(xi, sigma))


def _limits(xi: Array, sigma: Array) -> tuple[float, float]:
    """Limits of an axis: the newest band whole, earlier ones as far as their sigma is usual.

    First estimates with large errors and bands to match are cut off.
    """
    known = np.asarray(np.isfinite(sigma).all(axis=1), dtype=np.bool_)
    band = np.where(known[:, None], _SIGMAS * sigma, 0.0)
    found_by = np.ones_like(xi, dtype=np.bool_)
    if known.any():
        limit = _SURE * np.median(band[known], axis=0)
        found_by = np.where(known[:, None], band <= limit, False)
    low = min(np.percentile((xi - band)[found_by], _SHOWN_PERCENT[0]), -band[-1].max())
    high = max(np.percentile((xi + band)[found_by], _SHOWN_PERCENT[1]), band[-1].max())
    margin = _MARGIN * (high - low)
    return min(low - margin, -_SMALLEST), max(high + margin, _SMALLEST)


def _draw_events(panel: Axes, events: Sequence[Event], zero: int, newest: int) -> None:
    """A line where each began, shaded until it was found; a blind camera's until it has matches.

    With a label over it where there are few.
    """
    across = panel.get_xaxis_transform()
    for kind in {event.kind for event in events}:
        of_kind = [event for event in events if event.kind == kind]
        starts = [event.frame - zero for event in of_kind]
        widths = [_end(event, events, newest) - event.frame for event in of_kind]
        colour = _EVENTS.get(kind, _INSTEAD)
        panel.vlines(starts, 0, 1, color=colour, linewidth=1.2, transform=across)
        shades = list(zip(starts, widths, strict=True))
        panel.broken_barh(shades, (0, 1), color=colour, alpha=0.12, linewidth=0, transform=across)
    for event in events if len(events) <= _LABELLED else ():
        panel.annotate(
            event.kind if event.camera is not None else f"LiDAR {event.kind}",
            (event.frame - zero, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2),
            textcoords="offset points", ha="center", va="bottom", fontsize=9,
            color=_EVENTS.get(event.kind, _INSTEAD),
        )  # fmt: skip


def _end(event: Event, events: Sequence[Event], newest: int) -> int:
    """The frame until which an event is shaded."""
    if event.kind != "blind":
        return event.detected_frame
    later = [e.frame for e in events if e.kind == "back" and e.frame >= event.frame]
    return min(later, default=newest)


def _legend(kinds: set[Kind]) -> list[Artist]:
    """A handle for each colour that occurs."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=colour, label=f"camera's {axis}") for axis, colour in _AXES.items()
    ]
    handles.append(Patch(color="0.5", alpha=0.3, label="3 sigma"))
    handles += [
        Line2D(
            [],
            [],
            color=colour,
            marker="|",
            markersize=12,
            linestyle="none",
            label=_LEGEND_TEXTS[kind],
        )
        for kind, colour in _EVENTS.items()
        if kind in kinds
    ]
    return handles


_LEGEND_TEXTS: dict[Kind, str] = {
    "moved": "moved (shaded until found)",
    "drifts": "drifts (shaded until found)",
    "blind": "blind: no usable matches",
    "back": "back: matches again",
}
