"""The extrinsics against time, in constant memory, and their picture.

They are thinned evenly as the drive grows; the picture has 3-sigma bands and events.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import twist_between
from calibgraph.report.figure import new_picture, save_picture
from calibgraph.tracking.assessment import Update, shared_parts
from calibgraph.tracking.events import Event, Kind

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
if TYPE_CHECKING:
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


_MOST_EVENTS = 1000
_POSE = 6


class History:
    """The extrinsics after each update, in constant memory: thinned evenly as it grows.

    Args:
        most: entries that are held at most, 2 or more. With one more, every second is dropped, and
            from then on only every 2nd (4th, ...) update is kept; the newest always is.
    """

    def __init__(self, most: int = 2000) -> None:
        if most < 2:  # noqa: PLR2004 - the first and the newest
            raise ValueError(f"most is {most}; a history holds at least 2 entries")
        self._most = most
        self._stride = 1
        self._updates = 0
        self._held = 0  # entry i is update i * stride, but for the last: that is the newest
        self._origins: dict[str, Array] = {}  # T_camera_lidar that the entries are relative to
        self._begun: set[str] = set()
        self._frames = np.empty(0, dtype=np.int64)
        self._entries = np.empty((0, 0, 2 * _POSE))  # xi, sigmas; NaN: not known
        self._events: tuple[Event, ...] = ()
        self._newest: tuple[Update, Array] | None = None  # with its entries

    def __len__(self) -> int:
        """How many entries are held."""
        return self._held

    @property
    def events(self) -> tuple[Event, ...]:
        """All events, or the last 1000."""
        return self._events

    def add(self, update: Update) -> None:
        """Add the estimates after a frame.

        Raises:
            ValueError: if its cameras are not those of the updates before.
        """
        if not self._origins:
            self._begin(update)
        if update.T_camera_lidar.keys() != self._origins.keys():
            raise ValueError(
                f"frame {update.frame}: the update is of cameras {[*update.T_camera_lidar]}, those "
                f"before of {[*self._origins]}; keep one history per rig"
            )
        self._events = (*self._events, *update.events)[-_MOST_EVENTS:]
        self._begun |= {e.camera for e in update.events if e.kind == "started" and e.camera}
        self._make_place()
        self._frames[self._held] = update.frame
        self._entries[self._held] = self._entries_of(update)
        self._held += 1
        self._updates += 1

    def _begin(self, update: Update) -> None:
        self._frames = np.empty(self._most, dtype=np.int64)
        shape = self._most, len(update.T_camera_lidar), 2 * _POSE
        self._entries = np.full(shape, np.nan)
        self._origins = dict(update.T_camera_lidar)

    def _make_place(self) -> None:
        """Drop the last entry unless its number is a multiple of the stride; thin if full."""
        if (self._updates - 1) % self._stride:
            self._held -= 1
        if self._held == self._most:
            self._held = len(self._frames[::2])
            self._frames[: self._held] = self._frames[::2].copy()
            self._entries[: self._held] = self._entries[::2].copy()
            self._stride *= 2

    def _entries_of(self, update: Update) -> Array:
        """(n, 12) of the cameras; those of the update before, if it was taken in with this one."""
        before = self._newest
        if before is None or update.events or shared_parts(update) != shared_parts(before[0]):
            found = np.array([self._entry(update, name) for name in self._origins])
            before = self._newest = update, found
        return before[1]

    def _entry(self, update: Update, name: str) -> Array:
        """(12,) xi in T_camera_lidar = exp(xi) origin, sigmas; NaN: not known."""
        covariance = update.covariance.get(name)
        entry = np.full(2 * _POSE, np.nan)
        if covariance is not None:  # a camera may have started in an earlier run
            self._begun.add(name)
            variances = np.diag(covariance)
            entry[_POSE:] = np.sqrt(np.where(variances >= 0, variances, np.nan))
        if name in self._begun:
            entry[:_POSE] = twist_between(update.T_camera_lidar[name], self._origins[name])
        return entry

    def curves(self) -> dict[str, Curve | None]:
        """Per camera its extrinsic relative to the newest; None if it has no estimate yet."""
        return {name: self._curve(camera) for camera, name in enumerate(self._origins)}

    def _curve(self, camera: int) -> Curve | None:
        entries = self._entries[: self._held, camera]
        known = np.isfinite(entries[:, :_POSE]).all(axis=1)
        if not known.any():
            return None
        steps = [gtsam.Pose3.Expmap(xi).matrix() for xi in entries[known, :_POSE]]
        xi = np.array([twist_between(step, steps[-1]) for step in steps])
        xi[-1] = 0.0  # up to rounding it is
        return Curve(self._frames[: self._held][known], xi, entries[known, _POSE:])

    def draw(self, path: Path) -> None:
        """Draw all cameras' curves with their 3-sigma bands and the events; PNG, atomically.

        Args:
            path: of the picture.

        Raises:
            FileError: if it cannot be written there.
        """
        save_picture(self.figure(), path)

    def figure(self) -> Figure:
        """Make the picture, to be changed or shown by the caller."""
        if len(self) < 2:  # noqa: PLR2004 - a curve has two ends
            return text_figure(f"Nothing to draw: {len(self)} frames so far.")
        first, newest = int(self._frames[0]), int(self._frames[self._held - 1])
        return history_figure(self.curves(), self.events, first, newest)
