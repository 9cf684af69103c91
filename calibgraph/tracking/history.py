"""The extrinsics against time, in constant memory, and their picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.geometry import invert
from calibgraph.model.pose_kernel import logarithms
from calibgraph.report.figure import new_picture, save_picture
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.events import Event, Kind

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours that differ for the colour-blind too (Okabe and Ito, "Color universal design").
_AXES = {"x": "#0072B2", "y": "#E69F00", "z": "#009E73"}
_EVENTS: dict[Kind, str] = {
    "moved": "#D55E00", "drifts": "#A0408A", "blind": "#555555", "back": "#3399D0",
}  # fmt: skip
_PARTS = (
    (slice(0, 3), "rotation [deg]", float(np.degrees(1.0))),
    (slice(3, 6), "translation [cm]", 100.0),
)
"""Rows of xi, what they are, and how many units one rad or m is."""

_MOST, _MOST_EVENTS = 2000, 1000
_WIDTH_IN, _ROW_IN, _FRAME_IN = 16.0, 2.5, 1.5
_NAME_LETTERS = 24
_SIGMAS = 3.0
_SURE = 3.0  # times the median sigma: an estimate with more does not set the scale
_SMALLEST = 1e-3  # half of an axis' range, in its unit
_HELD: Literal["steps-post"] = "steps-post"  # an estimate is valid until the next


@dataclass
class History:
    """The extrinsics after updates: thinned evenly as it grows; the newest always is among them.

    Attributes:
        most: entries that are held; with one more, every second is dropped, and from then on only
            every 2nd (4th, ...) update is kept.
        events: the last 1000 events.
    """

    most: int = _MOST
    events: tuple[Event, ...] = ()
    _kept: list[tuple[int, Array, Array]] = field(default_factory=list)
    _newest: Update | None = None
    _stride: int = 1
    _updates: int = 0

    def add(self, update: Update) -> None:
        """Add the estimates after a frame."""
        self.events = (*self.events, *update.events)[-_MOST_EVENTS:]
        if self._updates % self._stride == 0:
            self._kept.append(_entry(update))
        if len(self._kept) > self.most:
            self._kept, self._stride = self._kept[::2], 2 * self._stride
        self._newest = update
        self._updates += 1

    def curves(self) -> tuple[Array, dict[str, tuple[Array, Array]]]:
        """(f,) numbers of frames, and per camera (f, 6) xi and (f, 6) its standard deviations.

        T_camera_lidar(frame) = exp(xi) T_camera_lidar(newest), xi = (rotation [rad], translation
        [m]) in the camera's axes; NaN while the error bar is not known.
        """
        assert self._newest is not None
        newest = _entry(self._newest)
        entries = self._kept if self._kept[-1][0] == newest[0] else [*self._kept, newest]
        numbers, poses, sigmas = (np.array(part) for part in zip(*entries, strict=True))
        curves = {}
        for camera, name in enumerate(self._newest.T_camera_lidar):
            xi = logarithms(np.asarray(poses[:, camera] @ invert(newest[1][camera])))
            xi = np.where(np.isnan(sigmas[:, camera, :1]), np.nan, xi)
            curves[name] = xi, np.asarray(sigmas[:, camera])
        return numbers, curves

    def draw(self, path: Path) -> None:
        """Draw all cameras' curves with their 3-sigma bands and the events; PNG, atomically.

        Raises:
            FileError: if it cannot be written there.
        """
        save_picture(self.figure(), path)

    def figure(self) -> Figure:
        """Make the picture, a row per camera: rotation and translation."""
        numbers, curves = self.curves()
        zero = int(numbers[0])
        figure = new_picture(_WIDTH_IN, _FRAME_IN + _ROW_IN * len(curves))
        panels = figure.subplots(len(curves), len(_PARTS), sharex=True, squeeze=False)
        for (name, (xi, sigma)), row in zip(curves.items(), panels, strict=True):
            own = [e for e in self.events if e.camera in (name, None) and e.kind in _EVENTS]
            for panel, (rows, title, units) in zip(row, _PARTS, strict=True):
                label = name if len(name) <= _NAME_LETTERS else f"{name[: _NAME_LETTERS - 1]}…"
                panel.set_ylabel(f"{label}\n{title}", parse_math=False)
                panel.grid(color="0.9", linewidth=0.8)
                _draw_curve(panel, numbers - zero, units * xi[:, rows], units * sigma[:, rows])
                _draw_events(panel, own, zero)
        for panel in panels[-1]:
            panel.set_xlabel(f"frame number - {zero}" if zero else "frame number")
        figure.align_ylabels(panels)
        figure.suptitle(
            f"Frames {numbers[0]} to {numbers[-1]}: T_camera_lidar less its newest estimate, with "
            "3 sigma\np_camera = T_camera_lidar * p_lidar, about and along the camera's axes",
            fontsize=12,
        )
        _add_legend(figure, {e.kind for e in self.events})
        return figure


def _entry(update: Update) -> tuple[int, Array, Array]:
    """Number of the frame; (n, 4, 4) T_camera_lidar; (n, 6) sigmas, NaN where they are unknown."""
    variances = [
        np.full(6, np.nan) if one is None else np.diag(one) for one in update.covariance.values()
    ]
    with np.errstate(invalid="ignore"):
        sigmas = np.sqrt(variances)
    return update.frame, np.array([*update.T_camera_lidar.values()]), sigmas


def _draw_curve(panel: Axes, numbers: Array, xi: Array, sigma: Array) -> None:
    """Three lines in their bands."""
    known = np.isfinite(sigma).all(axis=1)
    if not known.any():
        panel.text(0.5, 0.5, "no estimate yet", ha="center", transform=panel.transAxes, color="0.4")
        panel.set_yticks([])
        return
    low, high = xi - _SIGMAS * sigma, xi + _SIGMAS * sigma
    for axis, colour in enumerate(_AXES.values()):
        band = low[:, axis], high[:, axis]
        panel.fill_between(numbers, *band, color=colour, alpha=0.17, linewidth=0, step="post")
        for edge in band:  # so that overlapping bands can be distinguished
            panel.plot(numbers, edge, color=colour, alpha=0.5, linewidth=0.6, drawstyle=_HELD)
        panel.plot(numbers, xi[:, axis], color=colour, linewidth=1.4, drawstyle=_HELD)
    usual = sigma <= _SURE * np.median(sigma[known], axis=0)  # wider first bands are cut off
    bottom, top = min(low[usual], default=0.0), max(high[usual], default=0.0)
    panel.set_ylim(min(1.1 * bottom, -_SMALLEST), max(1.1 * top, _SMALLEST))


def _draw_events(panel: Axes, events: Sequence[Event], zero: int) -> None:
    """A line where each began, shaded until it was found."""
    across = panel.get_xaxis_transform()
    for kind in {event.kind for event in events}:
        starts = [event.frame - zero for event in events if event.kind == kind]
        ends = [event.detected_frame - zero for event in events if event.kind == kind]
        colour = _EVENTS[kind]
        panel.vlines(starts, 0, 1, color=colour, linewidth=1.2, transform=across)
        shades = [(start, end - start) for start, end in zip(starts, ends, strict=True)]
        panel.broken_barh(shades, (0, 1), color=colour, alpha=0.12, linewidth=0, transform=across)


def _add_legend(figure: Figure, kinds: set[Kind]) -> None:
    """A handle for each colour that occurs."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=c, label=f"camera's {axis}") for axis, c in _AXES.items()]
    handles += [
        Line2D([], [], color=colour, marker="|", markersize=12, linestyle="none", label=kind)
        for kind, colour in _EVENTS.items()
        if kind in kinds
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
