"""A tracker whose every update is on disk when it returns."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from operator import index
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from calibgraph.errors import CorrespondenceError, FileError
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from calibgraph.model.rig import Rig
from calibgraph.tracking.assessment import Update
from calibgraph.tracking.frame_order import (
    require_number,
    with_metadata_per_frame,
    with_place,
)
from calibgraph.tracking.state_bytes import StateError, decode, encode
from calibgraph.tracking.state_database import StateDatabase
from calibgraph.tracking.streams import StreamFrame
from calibgraph.tracking.tracker import IncrementalCalibrator

_SNAPSHOT_EVERY = 50  # updates: a restart repeats up to so many, and those of two writes


class DurableCalibrator:
    """An :class:`IncrementalCalibrator` that survives ``kill -9`` at any moment.

    An update that has returned is on disk. After a restart, the next update gives the same numbers
    as without the restart.

    Attributes:
        tracker: the calibrator that is kept on disk.
        damages: one line for each damaged part of the state that was found and is not used.
        resumed: whether there was a state to continue from.
        repeated: after a crash, the updates since a snapshot, of which those of the last write may
            not have returned then; none after a :meth:`close`.
        last_repeated: those of the last call among them.

    Args:
        folder: where the state is kept; one process at a time.
        rig: cameras with their initial guess.
        config: settings; the preset ``auto`` if None.
        begin: computes a better guess than ``rig``; called only if there is no state yet.

    Raises:
        FileError: if another process uses the folder, or the state in it is damaged, of another
            layout, another rig or other settings. The state is left as it was.
    """

    def __init__(
        self,
        folder: Path | str,
        rig: Rig,
        config: Config | None = None,
        *,
        begin: Callable[[], Rig] | None = None,
    ) -> None:
        self._database = StateDatabase(Path(folder))
        try:
            recovered = self._database.recovered
            self.damages = recovered.damages
            self._unwritten: tuple[bytes, int] | None = None
            if recovered.snapshot is None:
                self.tracker = IncrementalCalibrator(begin() if begin else rig, config)
                self._snapshot()
            else:
                with _of_this_version(Path(folder)):
                    self.tracker = IncrementalCalibrator.from_bytes(recovered.snapshot)
                _require_same(Path(folder), self.tracker, rig, config or Config())
            self._held: list[bytes] | None = None
            with _of_this_version(Path(folder)):
                inputs = [*map(self._repeat, recovered.inputs)]
            self.repeated = tuple(chain.from_iterable(inputs))
            self.last_repeated = inputs[-1] if inputs else []
            self._pending = len(self.repeated)
        except BaseException:
            self._database.close()
            raise
        self.resumed = self.tracker.frame is not None

    def update(
        self, table: Correspondences, *, frame: int | None = None, place: str | int | None = None
    ) -> Update:
        """Take in one frame, see :meth:`IncrementalCalibrator.update`; it is on disk then.

        Raises:
            CorrespondenceError: as there. Nothing has changed then.
            OSError: if it cannot be written; then close this, and make a new one.
        """
        table = _as_kept(table, place)
        record = _record((frame, table))
        with self._write() as held:
            update = self.tracker.update(table, frame=frame)
            held.append(record)
            self._pending += 1
            return update

    def update_together(self, frames: Sequence[StreamFrame]) -> list[Update]:
        """As :meth:`IncrementalCalibrator.update_together`; they are on disk then.

        Raises:
            OSError: if they cannot be written; then close this, and make a new one.
        """
        with self._write() as held:
            updates = self.tracker.update_together(frames)
            if updates:
                taken = frames[: len(updates)]
                held.append(_record(*((one.frame, _as_kept(one.table, None)) for one in taken)))
                self._pending += len(updates)
            return updates

    def _repeat(self, record: bytes) -> list[Update]:
        """Take in again what a row of the journal has."""
        frames = [StreamFrame(frame, table) for frame, table in decode(record, "input")]
        if len(frames) == 1:
            return [self.tracker.update(frames[0].table, frame=frames[0].frame)]
        updates = self.tracker.update_together(frames)
        if len(updates) < len(frames):
            raise StateError("frames of one input do not go together")
        return updates

    @contextmanager
    def _write(self) -> Iterator[list[bytes]]:
        """The records of a write that is open, or of one of its own."""
        if self._held is not None:
            yield self._held
            return
        with self.in_one_write():
            assert self._held is not None
            yield self._held

    @contextmanager
    def in_one_write(self) -> Iterator[None]:
        """Updates inside are on disk when this has ended, and not before: by one write for all.

        A snapshot waits for the end, so a restart after a kill repeats all of a long block.

        Raises:
            OSError: if they cannot be written; then close this, and make a new one.
        """
        self._continue_snapshot()  # before the updates: the journal always holds the last one
        held: list[bytes] = []
        self._held = held
        try:
            yield
        finally:
            self._held = None
            if held:
                self._database.append(*held)

    def _continue_snapshot(self) -> None:
        """Encode the state when it is due, write it with the next update: neither waits long."""
        if self._unwritten is not None:
            self._write_snapshot(*self._unwritten)
        elif self._pending >= _SNAPSHOT_EVERY:
            self._unwritten = self.tracker.to_bytes(), self._database.number
            self._pending = 0

    def close(self) -> None:
        """Write a last snapshot and release the folder."""
        try:
            self._snapshot()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Release the folder without a last snapshot: the journal has every update that returned.

        For a tracker that may be in the middle of an update, as after an error.
        """
        self._database.close()

    def _snapshot(self) -> None:
        self._write_snapshot(self.tracker.to_bytes(), self._database.number)
        self._pending = 0

    def _write_snapshot(self, state: bytes, number: int) -> None:
        self._database.snapshot(state, number)
        self._unwritten = None

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


def _as_kept(table: Correspondences, place: str | int | None) -> Correspondences:
    return with_metadata_per_frame(with_place(table, place))


def _record(*frames: tuple[int | None, Correspondences]) -> bytes:
    """An input as the journal keeps it."""
    for frame, _ in frames:
        require_number(frame)
    try:
        return encode(tuple((None if n is None else index(n), t) for n, t in frames), "input")
    except UnicodeEncodeError as error:  # of a camera, which no rig has
        raise CorrespondenceError(f"a camera's name cannot be written ({error})") from error


@contextmanager
def _of_this_version(folder: Path) -> Iterator[None]:
    """Refuse what is not damaged, by its checksum in the database, but cannot be continued."""
    try:
        yield
    except (StateError, CorrespondenceError) as error:
        raise FileError(
            folder, f"holds a state of another version; choose another folder ({error})"
        ) from error


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
