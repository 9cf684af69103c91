"""A tracker whose every update is on disk when it returns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.frame_order import StreamFrame, as_kept, frame_of
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.state_database import StateDatabase
from calibgraph.tracking.tracker import IncrementalCalibrator, Outcome

_STATE_EVERY = 50  # updates, of which a restart repeats up to so many and those of one write


class DurableCalibrator:
    """An :class:`IncrementalCalibrator` that survives ``kill -9`` at any moment.

    An update that has returned is on disk. After a restart, the next update gives the same numbers
    as without the restart.

    Attributes:
        tracker: the calibrator that is kept on disk.
        resumed: whether there was a state to continue from.
        repeated: after a crash, the updates of the last write, which may not have returned then.

    Args:
        folder: where the state is kept; one process at a time.
        rig: cameras with their initial guess.
        config: settings; the preset ``auto`` if None.
        begin: computes a better guess than ``rig``; called only if there is no state yet.

    Raises:
        FileError: if another process uses the folder, or the state in it is damaged, of another
            version, another rig or other settings.
    """

    def __init__(
        self,
        folder: Path | str,
        rig: Rig,
        config: Config | None = None,
        *,
        begin: Callable[[], Rig] | None = None,
    ) -> None:
        folder = Path(folder)
        self._database = StateDatabase(folder)
        self.tracker: IncrementalCalibrator
        self.repeated: list[Update] = []
        self._since = 0  # updates since the state that is on disk
        try:
            if rows := self._database.read():
                self._resume(folder, *rows)
                _require_same(folder, self.tracker, rig, config or Config())
            else:
                self.tracker = IncrementalCalibrator(begin() if begin else rig, config)
                self._write_state()
        except BaseException:
            self._database.close()
            raise
        self.resumed = self.tracker.frame is not None

    def _resume(self, folder: Path, state: bytes, *inputs: bytes) -> None:
        """Go on from a state, with the inputs after it as they were taken in together."""
        try:
            self.tracker = IncrementalCalibrator.from_bytes(state)
            for row in inputs:
                groups = decode(row, tuple)
                updates = [self.tracker.update_together(group) for group in groups]
                if [*map(len, updates)] != [*map(len, groups)]:
                    raise StateError("frames of one input do not go together")
                self.repeated = [*chain.from_iterable(updates)]
                self._since += len(self.repeated)
        except (StateError, CorrespondenceError) as error:
            advice = "choose another folder, or restore it from a copy"
            raise FileError(
                folder, f"holds a state that is damaged or of another version ({error}); {advice}"
            ) from error

    def update(
        self, table: Correspondences, *, frame: int | None = None, place: str | int | None = None
    ) -> Update:
        """Take in one frame, see :meth:`IncrementalCalibrator.update`; it is on disk then.

        Raises:
            CorrespondenceError: as there. Nothing has changed then.
            OSError: if it cannot be written; then close this, and make a new one.
        """
        (found,) = self.update_all([frame_of(table, frame, place)])
        if isinstance(found, CorrespondenceError):
            raise found
        return found[0]

    def update_all(self, frames: Sequence[StreamFrame]) -> list[Outcome]:
        """As :meth:`IncrementalCalibrator.update_all`; all are on disk then, by one write.

        Raises:
            OSError: if they cannot be written; then close this, and make a new one.
        """
        state = self.tracker.to_bytes() if self._since >= _STATE_EVERY else None
        before, left, groups = self._since, frames, []
        found = [*self.tracker.update_all(frames)]
        for one in found:
            taken = 1 if isinstance(one, CorrespondenceError) else len(one)
            if not isinstance(one, CorrespondenceError):
                groups.append(tuple(map(as_kept, left[:taken])))
            left = left[taken:]
        if groups:
            self._database.write([encode(tuple(groups))], state)
            self._since = sum(map(len, groups)) + (0 if state else before)
        return found

    def close(self) -> None:
        """Write the state and release the folder: a restart has nothing to repeat."""
        try:
            self._write_state()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Release the folder without the state: the inputs of all updates that returned are there.

        For a tracker that may be in the middle of an update, as after an error.
        """
        self._database.close()

    def _write_state(self) -> None:
        self._database.write([], self.tracker.to_bytes())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abandon()


def _require_same(folder: Path, tracker: IncrementalCalibrator, rig: Rig, config: Config) -> None:
    """The state in a folder must be of the same cameras and the same settings."""
    if _without_guess(tracker.initial_rig) != _without_guess(rig):
        raise FileError(
            folder,
            "holds the state of another rig (names, lenses, sizes or relative poses differ); "
            "choose another folder",
        )
    if tracker.config != config:
        differing = "; ".join(_differences(tracker.config.model_dump(), config.model_dump()))
        raise FileError(
            folder,
            f"holds a state made with other settings ({differing}); take these or another folder",
        )


def _differences(held: Mapping[str, Any], given: Mapping[str, Any]) -> Iterator[str]:
    """The settings that differ, with both values."""
    for key, value in given.items():
        if isinstance(value, dict):
            yield from _differences(held[key], value)
        elif held[key] != value:
            yield f"{key} {held[key]}, given {value}"


def _without_guess(rig: Rig) -> dict[str, object]:
    content = rig.model_dump(mode="json")
    for camera in content["cameras"].values():
        del camera["T_camera_lidar"]
    return content
