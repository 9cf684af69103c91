"""Matched planes as sums per cell: H, g of each pair of LiDARs at each place.

With T_i = T_base_lidar of LiDAR i, a plane (c, n) of i and one (d, m) of j have two residuals,
m . (T_i c - T_j d) and n . (T_i c - T_j d). By a twist of LiDAR i about the base's origin their
Jacobians are a = [c x m, m] and b = [d x n, n], all in the base frame, and their negatives by one
of j.

Normals err, and H of one normal alone, a a^T, would count these errors as knowledge: along a street
it states centimetres where nothing is known (errors in variables). The errors of two LiDARs are
independent but for what the surface itself does, whose roughness over its extent is the tilt t that
both share. So H = (a b^T + b a^T) / 2 - t^2 (A A^T - a a^T), with A = [c x; I] for every normal,
and the gradient is (b m . x + a n . x) / 2, of expectation 0 at the true pose. Of a pair at a place
only the directions count in which H is near what it would be if normals did not err.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.vehicle.planes import Planes

CELL_M = 4.0
"""Edge of the cells within which residuals err alike: the independent units."""

_CELL_NUMBERS = np.array([1, 2**12, 2**24])  # of steps along x, y, z: 2,048 either way
_PLACE_NUMBER = 2**40
_RELIABLE = 0.8  # of H over H without errors of normals: at places that determine all, over 0.9
_DETERMINED = 0.1  # of the same, over all pairs


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched planes of two LiDARs at one place, all in the base frame.

    Attributes:
        place: its number.
        one, other: numbers of the LiDARs.
        planes, others: (m) of each.
    """

    place: int
    one: int
    other: int
    planes: Planes
    others: Planes

    @property
    def residuals_m(self) -> tuple[Array, Array]:
        """(m,) by the other's normals, and by their own."""
        apart = self.planes.centers_m - self.others.centers_m
        return (self.others.normals * apart).sum(axis=1), (self.planes.normals * apart).sum(axis=1)


@dataclass(frozen=True, eq=False)
class Sums:
    """H and g of cells by the steps of all LiDARs but the base, in units of residuals.

    Attributes:
        hessian: (r, d, d), positive only in sum.
        gradient: (r, d).
        metric: (d, d) the sum of H without errors of normals.
    """

    hessian: Array
    gradient: Array
    metric: Array

    def basis(self) -> Array:
        """(d, q) directions that all pairs together determine."""
        values, vectors = scipy.linalg.eigh(self.hessian.sum(axis=0), self.metric)
        return np.asarray(vectors[:, values > _DETERMINED])


def sum_up(matches: Sequence[Matches], T_base_lidar: Array, scale_m: float) -> Sums:
    """The sums with the weights of a Cauchy loss of a width [m], at poses (k, 4, 4)."""
    steps, rows = _twists_by_steps(T_base_lidar), []
    metric = np.zeros((6 * len(T_base_lidar), 6 * len(T_base_lidar)))
    pairs = sorted({(m.place, *sorted((m.one, m.other))) for m in matches})
    for place, one, other in pairs:
        own = [m for m in matches if m.place == place and {m.one, m.other} == {one, other}]
        cells, hessian, gradient, whole = _of_pair(own, one, scale_m)
        by = steps[one] - steps[other]
        metric += by.T @ whole @ by
        kept = _reliable(hessian.sum(axis=0), whole)
        by = kept @ by
        rows.append((np.full(len(cells), place), cells, by.T @ hessian @ by, gradient @ by))
    places, cells, hessians, gradients = map(np.concatenate, zip(*rows, strict=True))
    row = np.unique(places * _PLACE_NUMBER + cells, return_inverse=True)[1]
    hessian, gradient = _added(row.ravel(), hessians), _added(row.ravel(), gradients)
    free = slice(6, None)  # but the base
    return Sums(hessian[:, free, free], gradient[:, free], metric[free, free])


def _twists_by_steps(T_base_lidar: Array) -> Array:
    """(k, 6, 6 k) twist of each LiDAR about the base's origin, by the steps of all.

    A step is a rotation about the LiDAR's own position, and a shift.
    """
    count = len(T_base_lidar)
    twists = np.zeros((count, 6, 6 * count))
    for number, T in enumerate(T_base_lidar):
        twists[number, :, 6 * number : 6 * number + 6] = np.eye(6)
        twists[number, 3:, 6 * number : 6 * number + 3] = _cross_matrix(T[None, :3, 3])[0]
    return twists


def _cross_matrix(vectors: Array) -> Array:
    """(n, 3, 3) of (n, 3), with matrix @ x = vector cross x."""
    matrix = np.zeros((len(vectors), 3, 3))
    for i, j, k, sign in ((0, 1, 2, -1.0), (1, 2, 0, -1.0), (2, 0, 1, -1.0)):
        matrix[:, i, j], matrix[:, j, i] = sign * vectors[:, k], -sign * vectors[:, k]
    return matrix


def _of_pair(
    matches: Sequence[Matches], one: int, scale_m: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Numbers of cells (c,), their H (c, 6, 6) and g (c, 6) by the twist of one against the other.

    And H of all, (6, 6), as if normals did not err.
    """
    cells, hessians, gradients = [], [], []
    whole = np.zeros((6, 6))
    for own in matches:
        points, others = own.planes.centers_m, own.others.centers_m
        by_others, by_own = own.residuals_m
        weight = 1.0 / (1.0 + 0.5 * (by_others**2 + by_own**2) / scale_m**2)
        a = np.hstack([np.cross(points, own.others.normals), own.others.normals])
        b = np.hstack([np.cross(others, own.planes.normals), own.planes.normals])
        every = np.concatenate([_cross_matrix(points), np.tile(np.eye(3), (len(points), 1, 1))], 1)
        across = every @ every.transpose(0, 2, 1) - a[:, :, None] * a[:, None, :]
        shared = 0.5 * (own.planes.tilts**2 + own.others.tilts**2)
        product = a[:, :, None] * b[:, None, :]
        whole += 0.5 * ((a.T * weight) @ a + (b.T * weight) @ b)
        hessian = 0.5 * (product + product.transpose(0, 2, 1)) - shared[:, None, None] * across
        gradient = 0.5 * (b * by_others[:, None] + a * by_own[:, None])
        hessians.append(weight[:, None, None] * hessian)
        gradients.append(weight[:, None] * gradient * (1.0 if own.one == one else -1.0))
        cells.append(np.floor(points / CELL_M).astype(np.int64) @ _CELL_NUMBERS)
    named, row = np.unique(np.concatenate(cells), return_inverse=True)
    hessian, gradient = np.concatenate(hessians), np.concatenate(gradients)
    return named, _added(row.ravel(), hessian), _added(row.ravel(), gradient), whole


def _added(rows: NDArray[np.int64], values: Array) -> Array:
    """The sums of values with equal row."""
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def _reliable(hessian: Array, whole: Array) -> Array:
    """(6, 6) projection of twists onto directions in which normals hold, along the others."""
    ridge = 1e-12 * np.diag(np.diag(whole)) + np.finfo(float).tiny * np.eye(6)
    values, vectors = scipy.linalg.eigh(hessian, whole + ridge)
    kept = vectors[:, values > _RELIABLE]
    return np.asarray(kept @ kept.T @ whole)
