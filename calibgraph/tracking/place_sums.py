"""Sums of frames, place by place: what the error model is made from, in constant memory.

The places that were visited last are kept apart, so that whoever comes back adds to the same one.
Older ones are one row: its frames' errors count as those of as many places as are in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.tracking.live_frames import LiveFrame

Array = NDArray[np.float64]

MOST_PLACES = 24
"""Places that are kept apart."""

_OLDER = "\0"  # name of the first row, which no place has
_ROWS = ("hessian", "gradient", "reweighted", "score", "frames", "matches")
_SHAPES = ((6, 6), (6,), (6, 6), (6,), (6, 6), (), ())  # of a part, per camera


@dataclass(frozen=True, eq=False)
class PlacePart:
    """Sums of some frames of one place.

    Attributes:
        name: of the place.
        hessian: (n, 6, 6) true Hessian, per camera.
        gradient: (n, 6) at the references.
        reweighted: (n, 6, 6) Hessian by the matches' weights in the loss, positive semidefinite.
        score: (n, 6) sum of the frames' gradients, each at the estimate of its time.
        scatter: (n, 6, 6) sum of the outer products of the same.
        frames, matches: (n,).
    """

    name: str
    hessian: Array
    gradient: Array
    reweighted: Array
    score: Array
    scatter: Array
    frames: Array
    matches: Array


def parts_of(frames: Sequence[LiveFrame], steps: Array) -> list[PlacePart]:
    """The sums of frames whose matches are kept, one per place.

    Args:
        frames: that have an extrinsic in common.
        steps: (n, 6) from the references to the estimate.
    """
    names = dict.fromkeys(frame.place for frame in frames)
    return [_part([f for f in frames if f.place == name], steps, name) for name in names]


def _part(frames: Sequence[LiveFrame], steps: Array, name: str) -> PlacePart:
    hessian = np.array([frame.hessian for frame in frames])
    gradient = np.array([frame.gradient for frame in frames])
    scores = gradient + np.einsum("fnij,nj->fni", hessian, steps)
    counts = np.zeros((len(frames), len(steps)))
    for row, frame in enumerate(frames):
        for camera, inliers in frame.inliers.items():
            counts[row, camera] = np.count_nonzero(inliers)
    return PlacePart(
        name,
        hessian.sum(axis=0),
        gradient.sum(axis=0),
        sum((frame.reweighted for frame in frames), np.zeros_like(hessian[0])),
        scores.sum(axis=0),
        np.einsum("fni,fnj->nij", scores, scores),
        np.count_nonzero(counts, axis=0).astype(np.float64),
        counts.sum(axis=0),
    )


@dataclass(frozen=True, eq=False)
class PlaceSums:
    """Sums of all cameras' frames, a row per place; the first row is of all older places.

    Attributes:
        names: (P,) of the places, the last visited last.
        hessian: (P, n, 6, 6) true Hessian of each camera's robust cost.
        gradient: (P, n, 6) at the references, which ``State`` holds.
        reweighted: (P, n, 6, 6) Hessian by the matches' weights in the loss.
        score: (P, n, 6) sum of the frames' gradients, each at the estimate of its time; 0 for older
            places.
        frames, matches: (P, n) how many.
        scatter: (n, 6, 6) sum of the outer products of all frames' gradients, of older places about
            the means of these.
        means: (n,) how many such means.
        older_squared: (n,) sum of the squares of the older places' numbers of frames.
    """

    names: tuple[str, ...]
    hessian: Array
    gradient: Array
    reweighted: Array
    score: Array
    frames: Array
    matches: Array
    scatter: Array
    means: Array
    older_squared: Array

    @staticmethod
    def empty(cameras: int) -> PlaceSums:
        """Of no frames."""
        n = cameras
        return PlaceSums(
            names=(_OLDER,),
            hessian=np.zeros((1, n, 6, 6)),
            gradient=np.zeros((1, n, 6)),
            reweighted=np.zeros((1, n, 6, 6)),
            score=np.zeros((1, n, 6)),
            frames=np.zeros((1, n)),
            matches=np.zeros((1, n)),
            scatter=np.zeros((n, 6, 6)),
            means=np.zeros(n),
            older_squared=np.zeros(n),
        )

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
    def of_all(self) -> tuple[Array, Array, Array]:
        """(n, 6, 6) scatter of the frames' gradients about the means of their places.

        Further (n,) frames, and (n,) how many of these the means leave.
        """
        frames = self.frames[1:]
        whole = np.maximum(frames, 1.0)
        by_mean = np.einsum("pni,pnj,pn->nij", self.score[1:], self.score[1:], 1.0 / whole)
        means = np.count_nonzero(frames, axis=0) + self.means
        every = self.frames.sum(axis=0)
        return self.scatter - by_mean, every, np.maximum(every - means, 0.0)

    def shift_reference(self, steps: Array) -> PlaceSums:
        """The sums about references that are moved by (n, 6) tangent steps."""
        return replace(
            self, gradient=self.gradient + np.einsum("pnij,nj->pni", self.hessian, steps)
        )

    def add(self, parts: Iterable[PlacePart]) -> PlaceSums:
        """The sums with frames added, their places the last visited."""
        sums = self
        for part in parts:
            sums = sums._visit(part.name)
            rows = {name: getattr(sums, name).copy() for name in _ROWS}
            for name, values in rows.items():
                values[-1] += getattr(part, name)
            sums = replace(sums, **rows, scatter=sums.scatter + part.scatter)
        return sums

    def _visit(self, name: str) -> PlaceSums:
        """The sums with the row of a place last."""
        if self.names[-1] == name:
            return self
        if name not in self.names:
            rows = {
                key: np.concatenate([values := getattr(self, key), np.zeros_like(values[:1])])
                for key in _ROWS
            }
            return replace(self, names=(*self.names, name), **rows)
        row = self.names.index(name)
        order = [*range(row), *range(row + 1, len(self.names)), row]
        rows = {key: getattr(self, key)[order] for key in _ROWS}
        return replace(self, names=tuple(self.names[i] for i in order), **rows)

    def bounded(self, most: int = MOST_PLACES) -> PlaceSums:
        """The sums with no more places kept apart: those not visited longest are older."""
        sums = self
        while len(sums.names) > 1 + most:
            sums = sums._merge_second()
        return sums

    def _merge_second(self) -> PlaceSums:
        """The second row added to the first."""
        rows = {}
        for name in _ROWS:
            values = getattr(self, name)
            first = values[:1] + values[1:2] if name != "score" else values[:1]
            rows[name] = np.concatenate([first, values[2:]])
        frames, score = self.frames[1], self.score[1]
        by_mean = np.einsum("ni,nj,n->nij", score, score, 1.0 / np.maximum(frames, 1.0))
        return replace(
            self,
            names=(_OLDER, *self.names[2:]),
            **rows,
            scatter=self.scatter - by_mean,
            means=self.means + (frames > 0),
            older_squared=self.older_squared + frames**2,
        )

    def without(self, camera: int) -> PlaceSums:
        """The sums without those of a camera."""
        names = (*_ROWS, "scatter", "means", "older_squared")
        values = {name: getattr(self, name).copy() for name in names}
        for name, array in values.items():
            array[(slice(None), camera) if name in _ROWS else camera] = 0.0
        return replace(self, **values)

    def with_camera_at(
        self, name: str, camera: int, sums: tuple[Array, Array, Array, float], matches: float
    ) -> PlaceSums:
        """The sums with all of a camera's frames at one place.

        Args:
            name: of the place.
            camera: by its place in the rig.
            sums: its (6, 6) Hessian, (6,) gradient at the reference, (6, 6) scatter, and number of
                frames.
            matches: of a frame.
        """
        n = len(self.scatter)
        part = PlacePart(name, *(np.zeros((n, *shape)) for shape in _SHAPES))
        part.hessian[camera], part.gradient[camera], part.scatter[camera] = sums[:3]
        part.reweighted[camera] = _without_negative(sums[0])
        part.frames[camera], part.matches[camera] = sums[3], sums[3] * matches
        return self.without(camera).add([part])


def _without_negative(hessian: Array) -> Array:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(hessian)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)
