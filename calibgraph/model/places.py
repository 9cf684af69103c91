"""Which frames share a place: stationary ones, which err the same, and near ones, which err alike.

On disk, lists of frame numbers in a table's metadata.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, StrictInt, TypeAdapter, ValidationError

from calibgraph.errors import CorrespondenceError

Numbers = NDArray[np.int64]
Groups = tuple[tuple[int, ...], ...]

PLACES = "places"
STATIONARY = "stationary"
_MOST_DESCRIBED = 8
KEYS = (PLACES, STATIONARY)


@dataclass(frozen=True)
class Places:
    """Groups of frame numbers.

    Attributes:
        stationary: frames during which the vehicle stands, a group per stop; they count as one.
        places: frames near each other, which show the same objects; None if nobody looked for them:
            then all frames are of one place, and so are those that no group names.
    """

    stationary: Groups = ()
    places: Groups | None = None

    @staticmethod
    def from_metadata(metadata: Mapping[str, Any]) -> Places:
        """Read the keys of a table's metadata.

        Raises:
            CorrespondenceError: if they are not lists of lists of frame numbers.
        """
        found = {}
        for name in (name for name in KEYS if name in metadata):
            try:
                found[name] = _READER.validate_python(metadata[name])
            except ValidationError as error:
                raise CorrespondenceError(
                    f"{name} of the table's metadata must be lists of frame numbers, as in "
                    f"[[0, 1, 2], [7, 8]], found {metadata[name]!r:.60}"
                ) from error
        return Places(found.get(STATIONARY, ()), found.get(PLACES))

    def to_metadata(self) -> dict[str, Any]:
        """As keys of the metadata; unknown values have no key."""
        known = {STATIONARY: self.stationary or None, PLACES: self.places}
        return {key: [list(g) for g in groups] for key, groups in known.items() if groups}

    def merge_stationary(self, frame: Numbers) -> Numbers:
        """(n,) frame numbers, with all frames of one stop replaced by its first."""
        for stop in self.stationary:
            frame = np.where(np.isin(frame, stop), np.int64(stop[0]), frame)
        return frame

    def _numbers_of(self, frame: Numbers) -> Numbers:
        """(f,) which place each frame is of."""
        groups = self.places or ()
        place_of = {number: place for place, group in enumerate(groups) for number in group}
        return np.array([place_of.get(number, len(groups)) for number in frame.tolist()], np.int64)

    def split(self, frame: Numbers) -> list[Numbers]:
        """(f,) numbers of frames, place by place."""
        place = self._numbers_of(frame)
        order = np.argsort(place, kind="stable")
        edges = np.flatnonzero(np.diff(place[order])) + 1
        return [part for part in np.split(frame[order], edges) if len(part)]

    def of_frames(self, frame: Numbers) -> Groups:
        """The places of (n,) frame numbers; empty if nobody looked for them."""
        parts = [] if self.places is None else self.split(np.unique(frame))
        return as_groups([part.tolist() for part in parts])

    def frames_per_place(self, frame: Numbers) -> float:
        """Number of (f,) frames that share the error of a place, averaged over frames."""
        counts = np.bincount(self._numbers_of(frame))
        return float(counts @ counts / max(1, len(frame)))

    def name_of(self, number: int) -> str:
        """The place of a frame: the first number of its group; empty if no group has it."""
        return next((str(group[0]) for group in self.places or () if number in group), "")


_Frames = Annotated[tuple[StrictInt, ...], Field(min_length=1)]
_READER = TypeAdapter(tuple[_Frames, ...])
NOWHERE = Places()
"""Nobody looked for places."""


def as_groups(groups: Sequence[Sequence[int]]) -> Groups:
    """Lists of frame numbers as groups."""
    return tuple(tuple(group) for group in groups)


def describe_places(groups: Groups) -> str:
    """How many places, and the frames of the first of them, in a line."""
    named = "; ".join(map(_describe_numbers, groups[:_MOST_DESCRIBED]))
    more = f"; and {len(groups) - _MOST_DESCRIBED} more" if groups[_MOST_DESCRIBED:] else ""
    return f"{len(groups)} place{'s' if len(groups) > 1 else ''}: frames {named}{more}"


def _describe_numbers(group: Sequence[int]) -> str:
    """Ascending numbers in short, as in 0-4, 7."""
    runs = groupby(enumerate(group), key=lambda item: item[1] - item[0])
    numbers = ([number for _, number in run] for _, run in runs)
    return ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in numbers)
