"""What became of the extrinsics while the robot drove: kept in constant memory, drawn as curves."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from calibgraph.files import write_atomically
from calibgraph.tracking.events import Event, Kind
from calibgraph.tracking.tracker import Update

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_MOST_EVENTS = 1000
_POSE = 6

# Colours that differ for the colour-blind too (Okabe and Ito, "Color universal design").
_AXES = {"x": "#0072B2", "y": "#E69F00", "z": "#009E73"}
_EVENTS: dict[Kind, str] = {  # the more important first: their labels find a place first
    "moved": "#D55E00",
    "drifts": "#A0408A",
    "blind": "#555555",
    "back": "#3399D0",
}
_INSTEAD = "#000000"

_WIDTH_IN, _ROW_IN, _FRAME_IN, _DPI = 16.0, 2.5, 1.5, 100
_LABEL_LEVELS = 2  # of labels over each other
_LETTER = 0.0112  # width of a label's letter, as a share of the panel's
_NAME_LETTERS = 24
_SIGMAS = 3.0
_SURE = 3.0  # times the usual sigma: with more than that, an estimate does not set the scale
_SHOWN_PERCENT = (0.5, 99.5)
_MARGIN = 0.06
_HELD: Literal["steps-post"] = "steps-post"  # an estimate stands until the next
_SMALLEST = 1e-3  # half of an axis' range, in its unit
_LARGE_NUMBER = 10**7  # frames with such numbers are counted from the first


@dataclass(frozen=True, eq=False)
class Curve:
    """One camera's extrinsic against time.

    Attributes:
        frames: (n,) numbers of frames, from its first own estimate to its newest.
        xi: (n, 6) of T_camera_lidar(frame) = exp(xi) T_camera_lidar(newest), xi = (rotation [rad],
            translation [m]) in the camera's axes. The last is zero.
        sigma: (n, 6) standard deviations of xi; NaN where too few frames told them.
    """

    frames: NDArray[np.int64]
    xi: Array
    sigma: Array


class History:
    """What became of the extrinsics, in constant memory: thinned evenly as it grows.

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
        self._origins: dict[str, gtsam.Pose3] = {}  # what the entries are relative to
        self._begun: set[str] = set()
        self._frames = np.empty(0, dtype=np.int64)
        self._entries = np.empty((0, 0, 2 * _POSE))  # per camera xi, sigma; NaN: not known
        self._events: deque[Event] = deque(maxlen=_MOST_EVENTS)

    def __len__(self) -> int:
        """How many entries are held."""
        return self._held

    @property
    def events(self) -> tuple[Event, ...]:
        """What happened: all of it, or the last 1000."""
        return tuple(self._events)

    def add(self, update: Update) -> None:
        """Take in what is known after a frame.

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
        self._events.extend(update.events)
        self._begun |= {e.camera for e in update.events if e.kind == "started" and e.camera}
        self._make_place()
        self._frames[self._held] = update.frame
        self._entries[self._held] = [self._entry(update, name) for name in self._origins]
        self._held += 1
        self._updates += 1

    def _begin(self, update: Update) -> None:
        poses = {name: gtsam.Pose3(T) for name, T in update.T_camera_lidar.items()}
        self._frames = np.empty(self._most, dtype=np.int64)
        self._entries = np.full((self._most, len(poses), 2 * _POSE), np.nan)
        self._origins = poses

    def _make_place(self) -> None:
        """Drop the newest of before, unless its turn was to stay; thin if all places are taken."""
        if (self._updates - 1) % self._stride:
            self._held -= 1
        if self._held == self._most:
            self._held = len(self._frames[::2])
            self._frames[: self._held] = self._frames[::2].copy()
            self._entries[: self._held] = self._entries[::2].copy()
            self._stride *= 2

    def _entry(self, update: Update, name: str) -> Array:
        """(12,) xi in T_camera_lidar = exp(xi) origin, and its sigmas; NaN before it has begun."""
        covariance = update.covariance.get(name)
        entry = np.full(2 * _POSE, np.nan)
        if covariance is not None:  # also how a camera begins that had started in an earlier run
            self._begun.add(name)
            variances = np.diag(covariance)
            entry[_POSE:] = np.sqrt(np.where(variances >= 0, variances, np.nan))
        if name in self._begun:
            pose = gtsam.Pose3(update.T_camera_lidar[name])
            entry[:_POSE] = gtsam.Pose3.Logmap(pose * self._origins[name].inverse())
        return entry

    def curves(self) -> dict[str, Curve | None]:
        """Per camera how its extrinsic came to the newest; None if it has no estimate yet."""
        return {name: self._curve(camera) for camera, name in enumerate(self._origins)}

    def _curve(self, camera: int) -> Curve | None:
        entries = self._entries[: self._held, camera]
        known = np.isfinite(entries[:, :_POSE]).all(axis=1)
        if not known.any():
            return None
        poses = [gtsam.Pose3.Expmap(xi) for xi in entries[known, :_POSE]]
        to_newest = poses[-1].inverse()
        xi = np.array([gtsam.Pose3.Logmap(pose * to_newest) for pose in poses])
        xi[-1] = 0.0  # but for rounding it is
        return Curve(self._frames[: self._held][known], xi, entries[known, _POSE:])

    def draw(self, path: Path) -> None:
        """Draw all cameras' curves with their 3-sigma bands and the events; PNG, atomically.

        Args:
            path: of the picture.

        Raises:
            FileError: if it cannot be written there.
        """
        figure = self.figure()
        with warnings.catch_warnings():  # a name in letters that the font lacks: drawn as boxes
            warnings.filterwarnings("ignore", "Glyph", UserWarning)
            write_atomically(path, lambda part: figure.savefig(part, format="png", dpi=_DPI))

    def figure(self) -> Figure:
        """Make the picture, for those who want to change or show it themselves."""
        if len(self) < 2:  # noqa: PLR2004 - a curve has two ends
            return _sentence(f"Nothing to draw: {len(self)} frames so far.")
        first, newest = int(self._frames[0]), int(self._frames[self._held - 1])
        return _figure(self.curves(), self.events, first, newest)


def _new_figure(rows: int) -> Figure:
    """An empty picture that no global state knows of."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (_WIDTH_IN, _FRAME_IN + _ROW_IN * rows)
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _sentence(text: str) -> Figure:
    figure = _new_figure(1)
    figure.text(0.5, 0.5, text, ha="center", va="center", fontsize=14)
    return figure


def _figure(
    curves: dict[str, Curve | None], events: Sequence[Event], first: int, newest: int
) -> Figure:
    """A row per camera: rotation, translation."""
    figure = _new_figure(len(curves))
    panels = figure.subplots(len(curves), 2, sharex=True, squeeze=False)
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
    """Half of xi: its rows, what they are, and how many units one rad or m is."""

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
    for value, deviation, colour in zip(xi.T, sigma.T, _AXES.values(), strict=True):
        low, high = value - _SIGMAS * deviation, value + _SIGMAS * deviation
        panel.fill_between(frames, low, high, color=colour, alpha=0.17, linewidth=0, step="post")
        for edge in (low, high):  # they tell three bands apart that lie over each other
            panel.plot(frames, edge, color=colour, alpha=0.5, linewidth=0.6, drawstyle=_HELD)
    for value, colour in zip(xi.T, _AXES.values(), strict=True):
        panel.plot(frames, value, color=colour, linewidth=1.4, drawstyle=_HELD)
    panel.set_ylim(*_limits(xi, sigma))


def _limits(xi: Array, sigma: Array) -> tuple[float, float]:
    """What an axis shows: the newest band whole, and what came before as far as it was sure.

    First estimates that are wrong by a lot, with bands to match, run off the picture.
    """
    known = np.asarray(np.isfinite(sigma).all(axis=1), dtype=np.bool_)
    band = np.where(known[:, None], _SIGMAS * sigma, 0.0)
    sure = np.ones_like(xi, dtype=np.bool_)
    if known.any():
        limit = _SURE * np.median(band[known], axis=0)
        sure = np.where(known[:, None], band <= limit, False)
    low = min(np.percentile((xi - band)[sure], _SHOWN_PERCENT[0]), -band[-1].max())
    high = max(np.percentile((xi + band)[sure], _SHOWN_PERCENT[1]), band[-1].max())
    margin = _MARGIN * (high - low)
    return min(low - margin, -_SMALLEST), max(high + margin, _SMALLEST)


def _draw_events(panel: Axes, events: Sequence[Event], zero: int, newest: int) -> None:
    """A line where each began, shaded until it was found, and a label over it where there is room.

    A blind camera's is shaded until it sees again.
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
    _label_events(panel, events, zero)


def _end(event: Event, events: Sequence[Event], newest: int) -> int:
    """The frame until which an event is shaded."""
    if event.kind != "blind":
        return event.detected_frame
    later = [e.frame for e in events if e.kind == "back" and e.frame >= event.frame]
    return min(later, default=newest)


def _label_events(panel: Axes, events: Sequence[Event], zero: int) -> None:
    """Labels over the panel, none over another: those without room are left out."""
    start, end = panel.get_xlim()
    taken: list[list[tuple[float, float]]] = [[] for _ in range(_LABEL_LEVELS)]
    order = [*_EVENTS]
    for event in sorted(events, key=lambda e: order.index(e.kind) if e.kind in order else -1):
        place = event.frame - zero
        text = event.kind if event.camera is not None else f"LiDAR {event.kind}"
        half = _LETTER * (end - start) * (len(text) + 1) / 2
        middle = float(np.clip(place, start + half, end - half))
        extent = (middle - half, middle + half)
        level = next((n for n, others in enumerate(taken) if _is_free(extent, others)), None)
        if level is None or not start <= place <= end:
            continue
        taken[level].append(extent)
        panel.annotate(
            text, (middle, 1.0), xycoords=("data", "axes fraction"), xytext=(0, 2 + 11 * level),
            textcoords="offset points", ha="center", va="bottom", fontsize=9,
            color=_EVENTS.get(event.kind, _INSTEAD),
        )  # fmt: skip


def _is_free(extent: tuple[float, float], others: Sequence[tuple[float, float]]) -> bool:
    return all(extent[1] <= left or right <= extent[0] for left, right in others)


def _legend(kinds: set[Kind]) -> list[Artist]:
    """A handle for each colour that occurs."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Artist] = [
        Line2D([], [], color=colour, label=f"camera's {axis}") for axis, colour in _AXES.items()
    ]
    handles.append(Patch(color="0.5", alpha=0.3, label="3 sigma"))
    handles += [
        Line2D([], [], color=colour, marker="|", markersize=12, linestyle="none", label=_SAYS[kind])
        for kind, colour in _EVENTS.items()
        if kind in kinds
    ]
    return handles


_SAYS: dict[Kind, str] = {
    "moved": "moved (shaded until found)",
    "drifts": "drifts (shaded until found)",
    "blind": "blind: no usable matches",
    "back": "back: matches again",
}
