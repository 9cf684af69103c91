"""The extrinsics against time, in constant memory: thinned as the drive grows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from calibgraph.arrays import Array
from calibgraph.files import write_bytes
from calibgraph.model.geometry import twist_between
from calibgraph.report.figure import save_picture
from calibgraph.tracking.events import Event
from calibgraph.tracking.history_figure import Curve, history_figure, text_figure
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.update import Update, shared_parts

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MOST_EVENTS = 1000
_POSE = 6
_SAVED = "most", "stride", "updates", "origins", "begun", "frames", "entries", "events"


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

    def save(self, path: Path) -> None:
        """Write the history to a file, atomically; see :meth:`load`."""
        content = {name: getattr(self, f"_{name}") for name in _SAVED}
        held = {name: content[name][: self._held] for name in ("frames", "entries")}
        write_bytes(path, encode({**content, **held, "begun": [*self._begun]}, "history"))

    @staticmethod
    def load(path: Path) -> History:
        """The history of a file that :meth:`save` wrote; an empty one if there is none.

        A file that is damaged or of another version gives an empty history too: it is for the eye
        alone.
        """
        history = History()
        try:
            saved = decode(path.read_bytes(), "history")
            rooms = {name: _room(saved[name], saved["most"]) for name in ("frames", "entries")}
            content = {**saved, **rooms, "begun": {*saved["begun"]}, "held": len(saved["frames"])}
        except (OSError, StateError, AttributeError, KeyError, TypeError, ValueError):
            return history
        vars(history).update({f"_{name}": value for name, value in content.items()})
        return history

    def figure(self) -> Figure:
        """Make the picture, to be changed or shown by the caller."""
        if len(self) < 2:  # noqa: PLR2004 - a curve has two ends
            return text_figure(f"Nothing to draw: {len(self)} frames so far.")
        first, newest = int(self._frames[0]), int(self._frames[self._held - 1])
        return history_figure(self.curves(), self.events, first, newest)


def _room(held: Array, most: int) -> Array:
    """An array with room for more rows, the first of which are those that are held."""
    room = np.empty((most, *held.shape[1:]), held.dtype)
    room[: len(held)] = held
    return room
