"""Sums over frames: the one statistic that is left of matches, of epochs and places alike.

Near a reference T_lidar_camera, half the cost of a block of correspondences is
``d^T H d / 2 + b^T d + c`` for the tangent step d from the reference. Such sums add: thousands of
frames are one (H, b). H is the true Hessian of the robust cost: with it the step to the minimum is
exact to second order, while with the reweighted Hessian it is 20 to 40 percent too short. The
scatter ``B = sum g g^T`` of the frames' gradients is summed too: ``H^-1 B H^-1`` is the covariance.

If the extrinsic may have walked by a covariance Q since, then

    H' = (H^-1 + Q / k)^-1 = G H,   b' = G b,   B' = G B G^T + H' Q H'

so that ``H'^-1 B' H'^-1 = H^-1 B H^-1 + Q`` exactly, whatever the gain. k, the mean eigenvalue of
``H^-1 B`` per frame, is the overconfidence of H: matches of a frame share errors.

Place by place they are what the error model is made from. The places that were visited last are
kept apart, so that whoever comes back adds to the same one. Older ones are one row: its frames'
errors count as those of as many places as are in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array, Mask
from calibgraph.solver.covariance import positive_part
from factors import smallest_scaled_eigenvalues

Numbers = NDArray[np.int64]

_POSE = 6
_SQUARE = _POSE * _POSE
_SIZE = 3 * _SQUARE + 2 * _POSE + 2
_LEAST_EIGENVALUE = 1e-9  # of the unit-diagonal Hessian: rounding noise is near 1e-15


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums over frames. The leading axes (...), of frames, cameras or others, are alike in all.

    What is summed are views of one array, so that adding is one operation.

    Attributes:
        packed: (..., 122) of the properties, one after the other.
    """

    packed: Array

    @staticmethod
    def zeros(*shape: int) -> Sums:
        """Over no frames, with these leading axes."""
        return Sums(np.zeros((*shape, _SIZE)))

    @property
    def hessian(self) -> Array:
        """(..., 6, 6) true Hessian of the robust cost, in the tangent of T_lidar_camera."""
        return self._matrix(0)

    @property
    def reweighted(self) -> Array:
        """(..., 6, 6) Hessian by the matches' weights in the loss.

        It is positive semidefinite, of however few.
        """
        return self._matrix(1)

    @property
    def scatter(self) -> Array:
        """(..., 6, 6) sum of the outer products of the gradients of ``score``."""
        return self._matrix(2)

    @property
    def gradient(self) -> Array:
        """(..., 6) at the reference, which ``State`` holds."""
        return self.packed[..., -2 - 2 * _POSE : -2 - _POSE]

    @property
    def score(self) -> Array:
        """(..., 6) sum of the frames' gradients, each at the estimate of its time."""
        return self.packed[..., -2 - _POSE : -2]

    @property
    def frames(self) -> Array:
        """(...) how many."""
        return self.packed[..., -2]

    @property
    def matches(self) -> Array:
        """(...) how many."""
        return self.packed[..., -1]

    def _matrix(self, place: int) -> Array:
        rows = slice(place * _SQUARE, (place + 1) * _SQUARE)
        return self.packed[..., rows].reshape(*self.packed.shape[:-1], _POSE, _POSE)

    @property
    def scatter_about_mean(self) -> Array:
        """(..., 6, 6) of the frames' gradients."""
        whole = np.maximum(self.frames, 1.0)[..., None, None]
        outer = self.score[..., :, None] * self.score[..., None, :]
        return np.asarray(self.scatter - outer / whole)

    def change(self, **values: Array) -> Sums:
        """The sums with other values of some properties."""
        found = Sums(self.packed.copy())
        for name, value in values.items():
            getattr(found, name)[...] = value
        return found

    def __add__(self, other: Sums) -> Sums:
        return Sums(self.packed + other.packed)

    def __getitem__(self, index: Any) -> Sums:
        """A part of the leading axes."""
        return Sums(self.packed[index])

    def replace_at(self, index: Any, item: Sums) -> Sums:
        """The sums with a part of the leading axes replaced."""
        packed = self.packed.copy()
        packed[index] = item.packed
        return Sums(packed)

    def total(self) -> Sums:
        """The sum over the first axis."""
        return Sums(self.packed.sum(axis=0))

    def shift_reference(self, steps: Array) -> Sums:
        """The sums about references that are moved by (..., 6) tangent steps; axes broadcast."""
        moved = (self.hessian @ steps[..., None])[..., 0]
        return self.change(gradient=self.gradient + moved)

    def after_walk(self, variance: Array, overconfidence: Array) -> Sums:
        """The sums after a random walk.

        Args:
            variance: (..., 6) of the walk.
            overconfidence: (...) k of the module's description.
        """
        by, hessian = variance / overconfidence[..., None], self.hessian
        gain = np.linalg.inv(np.eye(_POSE) + hessian * by[..., None, :])
        hessian, back = gain @ hessian, gain.swapaxes(-1, -2)
        hessian = (hessian + hessian.swapaxes(-1, -2)) / 2
        kept = np.asarray(np.trace(gain, axis1=-2, axis2=-1) / _POSE)
        return Sums(self.packed * kept[..., None]).change(
            hessian=hessian,
            gradient=(gain @ self.gradient[..., None])[..., 0],
            scatter=gain @ self.scatter @ back + hessian * variance[..., None, :] @ hessian,
        )

    @property
    def are_determined(self) -> Mask:
        """(...) whether all directions of the pose are."""
        hessians = self.hessian
        values = smallest_scaled_eigenvalues(hessians.reshape(-1, _POSE, _POSE))
        return (values > _LEAST_EIGENVALUE).reshape(hessians.shape[:-2])


MOST_PLACES = 24
"""Places that are kept apart."""

_OLDER = "\0"  # name of the first row, which no place has


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
    def visited(self) -> list[int]:
        """The rows that have frames."""
        found: list[int] = np.nonzero(self.frames.any(axis=1))[0].tolist()
        return found

    @property
    def count(self) -> float:
        """Number of places."""
        older = self.places[0].max() if self.frames[0].any() else 0.0
        return float(np.count_nonzero(self.frames[1:].any(axis=1)) + older)

    @property
    def places(self) -> Array:
        """(P, n) as how many places with equally many frames each row counts."""
        counts, squared = np.ones_like(self.frames), self.older_squared
        if squared.any():
            counts[0] = np.where(
                squared > 0, self.frames[0] ** 2 / np.maximum(squared, 1e-300), 1.0
            )
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
        return replace(self, rows=self.rows.shift_reference(steps))

    def add(self, places: Sequence[str], sums: Sums) -> PlaceSums:
        """The sums with those of (f, n) frames at their places added, these the last visited."""
        visited = tuple(reversed(dict.fromkeys(reversed(places))))
        names = (*(name for name in self.names if name not in visited), *visited)
        row_of = {name: row for row, name in enumerate(names)}
        packed = np.zeros((len(names), *self.rows.packed.shape[1:]))
        packed[[row_of[name] for name in self.names]] = self.rows.packed
        if len(visited) == 1:
            packed[-1] += sums.packed.sum(axis=0)
        else:
            np.add.at(packed, [row_of[name] for name in places], sums.packed)
        return replace(self, names=names, rows=Sums(packed))

    def bounded(self, most: int = MOST_PLACES) -> PlaceSums:
        """The sums with no more places kept apart: those not visited longest are older."""
        kept = max(len(self.names) - most, 1)  # first row of these
        if kept == 1:
            return self
        old = self.rows[1:kept]
        old = old.change(score=np.zeros_like(old.score), scatter=old.scatter_about_mean)
        older = self.rows[:1] + Sums(old.packed.sum(axis=0, keepdims=True))
        return PlaceSums(
            (_OLDER, *self.names[kept:]),
            Sums(np.concatenate([older.packed, self.rows[kept:].packed])),
            self.means + np.count_nonzero(old.frames, axis=0),
            self.older_squared + np.square(old.frames).sum(axis=0),
        )

    def without(self, camera: int) -> PlaceSums:
        """The sums without those of a camera."""
        rows = self.rows.replace_at((slice(None), camera), Sums.zeros())
        kept = np.arange(len(self.means)) != camera
        return replace(
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
        none = Sums.zeros(1, len(self.means))
        return self.without(camera).add([name], none.replace_at((0, camera), part))


def block_diagonal(blocks: Array) -> Array:
    """(6 n, 6 n) from (n, 6, 6)."""
    n = len(blocks)
    matrix = np.zeros((n, 6, n, 6))
    matrix[np.arange(n), :, np.arange(n)] = blocks
    return matrix.reshape(6 * n, 6 * n)


def diagonal_blocks(matrix: Array) -> Array:
    """(n, 6, 6) of (6 n, 6 n)."""
    n = len(matrix) // 6
    return matrix.reshape(n, 6, n, 6)[np.arange(n), :, np.arange(n)]
