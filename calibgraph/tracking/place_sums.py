"""Sums of frames, place by place: what the error model is made from, in constant memory.

The places that were visited last are kept apart, so that whoever comes back adds to the same one.
Older ones are one row: its frames' errors count as those of as many places as are in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibgraph.arrays import Array
from calibgraph.solver.covariance import positive_part
from calibgraph.tracking.frozen import changed
from calibgraph.tracking.live_frames import LiveFrame
from calibgraph.tracking.sums import Sums

MOST_PLACES = 24
"""Places that are kept apart."""

_OLDER = "\0"  # name of the first row, which no place has


def sums_by_place(frames: Sequence[LiveFrame]) -> dict[str, Sums]:
    """(n,) sums of some frames at each of their places."""
    by_place: dict[str, list[Sums]] = {}
    for frame in frames:
        by_place.setdefault(frame.place, []).append(frame.sums)
    return {name: Sums.stack(sums).total() for name, sums in by_place.items()}


@dataclass(frozen=True, eq=False)
class PlaceSums:
    """Sums of all cameras' frames, a row per place; the first row is of all older places.

    Attributes:
        names: (P,) of the places, the last visited last.
        rows: (P, n) sums; of older places without score, their scatter about their own means.
        means: (n,) how many such means.
        older_squared: (n,) sum of the squares of the older places' numbers of frames.
    """

    names: tuple[str, ...]
    rows: Sums
    means: Array
    older_squared: Array

    @staticmethod
    def empty(cameras: int) -> PlaceSums:
        """Of no frames."""
        return PlaceSums((_OLDER,), Sums.zeros(1, cameras), np.zeros(cameras), np.zeros(cameras))

    @property
    def frames(self) -> Array:
        """(P, n) how many."""
        return self.rows.frames

    @property
    def is_of_one_place(self) -> bool:
        """Whether there is no second one."""
        return bool(np.count_nonzero(self.frames.any(axis=1)) <= 1)

    @property
    def places(self) -> Array:
        """(P, n) as how many places with equally many frames each row counts."""
        counts = np.ones_like(self.frames)
        squared = np.maximum(self.older_squared, 1e-300)
        counts[0] = np.where(self.older_squared > 0, self.frames[0] ** 2 / squared, 1.0)
        return counts

    @property
    def alike(self) -> Array:
        """(n,) frames of a place, in the mean over frames."""
        squared = self.older_squared + np.square(self.frames[1:]).sum(axis=0)
        return np.asarray(squared / np.maximum(self.frames.sum(axis=0), 1.0))

    @property
    def within_places(self) -> tuple[Array, Array]:
        """(n, 6, 6) scatter of the frames' gradients about the means of their places.

        Further (n,) the number of frames that the means leave.
        """
        about_means = self.rows[1:].scatter_about_mean.sum(axis=0) + self.rows.scatter[0]
        means = np.count_nonzero(self.frames[1:], axis=0) + self.means
        return about_means, np.maximum(self.frames.sum(axis=0) - means, 0.0)

    def shift_reference(self, steps: Array) -> PlaceSums:
        """The sums about references that are moved by (n, 6) tangent steps."""
        return changed(self, rows=self.rows.shift_reference(steps))

    def add(self, parts: Mapping[str, Sums]) -> PlaceSums:
        """The sums with (n,) sums at some places added, these the last visited."""
        sums = self
        for name, part in parts.items():
            sums = sums._visit(name)
            sums = changed(sums, rows=sums.rows.replace_at(-1, sums.rows[-1] + part))
        return sums

    def _visit(self, name: str) -> PlaceSums:
        """The sums with the row of a place last."""
        if self.names[-1] == name:
            return self
        others = [row for row, other in enumerate(self.names) if other != name]
        names = (*(self.names[row] for row in others), name)
        if name in self.names:
            return changed(self, names=names, rows=self.rows[[*others, self.names.index(name)]])
        new = Sums.zeros(len(self.means))
        rows = [*(self.rows[row] for row in others), new]
        return changed(self, names=names, rows=Sums.stack(rows))

    def bounded(self, most: int = MOST_PLACES) -> PlaceSums:
        """The sums with no more places kept apart: those not visited longest are older."""
        sums = self
        while len(sums.names) > 1 + most:
            sums = sums._merge_second()
        return sums

    def _merge_second(self) -> PlaceSums:
        """The second row added to the first."""
        second = self.rows[1]
        second = second.change(score=0.0 * second.score, scatter=second.scatter_about_mean)
        return PlaceSums(
            (_OLDER, *self.names[2:]),
            self.rows.replace_at(1, self.rows[0] + second)[1:],
            self.means + (second.frames > 0),
            self.older_squared + second.frames**2,
        )

    def without(self, camera: int) -> PlaceSums:
        """The sums without those of a camera."""
        rows = self.rows.replace_at((slice(None), camera), Sums.zeros())
        kept = np.arange(len(self.means)) != camera
        return changed(
            self, rows=rows, means=self.means * kept, older_squared=self.older_squared * kept
        )

    def with_camera_at(self, name: str, camera: int, own: Sums) -> PlaceSums:
        """The sums with all of a camera's frames at one place, as if about their mean.

        Args:
            name: of the place.
            camera: by its place in the rig.
            own: its sums, discounted by its walk.
        """
        reweighted = positive_part(own.hessian)
        part = own.change(score=np.zeros_like(own.score), reweighted=reweighted)
        none = Sums.zeros(len(self.means))
        return self.without(camera).add({name: none.replace_at(camera, part)})
