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

What is to be added to the ranges of i moves c along its ray u, so that a and b go on with m . u and
n . u, and A with u; likewise, with the other sign, for j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.geometry import adjoints
from calibgraph.vehicle.planes import PLANE

CELL_M = 4.0
"""Edge of the cells within which residuals err alike: the independent units."""

_CELL_NUMBERS = np.array([1, 2**12, 2**24])  # of steps along x, y, z: 2,048 either way
_PLACE_NUMBER = 2**40
_RELIABLE = 0.8  # of H over H without errors of normals: at places that determine all, over 0.9
_RIDGE = 1e-9  # of a sum's largest entry
_DETERMINED = 0.1  # of the same, over all pairs


MATCH = np.dtype([
    ("place", "i8"), ("one", "i8"), ("other", "i8"), ("plane", PLANE), ("of_other", PLANE)
])  # fmt: skip
"""A plane of a LiDAR and one of another, both in the base frame; numbers of place and LiDARs."""
Matches = NDArray[np.void]
"""(m,) of MATCH."""


def residuals_m(matches: Matches) -> Array:
    """(2, m) by the other's normals, and by their own."""
    plane, other = matches["plane"], matches["of_other"]
    apart = plane["center_m"] - other["center_m"]
    return np.stack([(each["normal"] * apart).sum(axis=1) for each in (other, plane)])


@dataclass(frozen=True, eq=False)
class Sums:
    """H and g of cells, in units of residuals.

    By the 6 steps of each LiDAR but the base, then by what is added to the ranges of each LiDAR.

    Attributes:
        hessian: (r, d, d), positive only in sum.
        gradient: (r, d).
        metric: (d, d) the sum of H without errors of normals.
    """

    hessian: Array
    gradient: Array
    metric: Array

    @property
    def of_poses(self) -> Sums:
        """The sums with the ranges as they are."""
        own = slice(6 * ((len(self.metric) + 6) // 7 - 1))  # of k LiDARs, d is 7 k - 6
        return Sums(self.hessian[:, own, own], self.gradient[:, own], self.metric[own, own])

    def basis(self) -> Array:
        """(d, q) directions that all pairs together determine."""
        values, vectors = scipy.linalg.eigh(self.hessian.sum(axis=0), _ridged(self.metric))
        return np.asarray(vectors[:, values > _DETERMINED])


def sum_up(matches: Matches, T_base_lidar: Array, scale_m: float) -> Sums:
    """The sums with the weights of a Cauchy loss of a width [m], at poses (k, 4, 4)."""
    count = len(T_base_lidar)
    steps = scipy.linalg.block_diag(step_twists(T_base_lidar), np.eye(count))[:, 6:]  # no base
    twists, ranges = np.split(steps, [6 * count])
    twists, rows, metric = twists.reshape(count, 6, -1), [], np.zeros((steps.shape[1],) * 2)
    cells = np.floor(matches["plane"]["center_m"] / CELL_M).astype(np.int64) @ _CELL_NUMBERS
    low, high = np.sort([matches["one"], matches["other"]], axis=0)
    pairs = (matches["place"] * count + low) * count + high
    order = np.lexsort((cells, pairs))
    starts = np.flatnonzero(np.diff(pairs[order], prepend=-1))
    for own in np.split(order, starts[1:]):
        place, one, other = matches["place"][own[0]], low[own[0]], high[own[0]]
        named, hessian, gradient, whole = _of_pair(matches[own], cells[own], one, scale_m)
        by = np.vstack([twists[one] - twists[other], ranges[[one, other]]])
        metric += by.T @ whole @ by
        kept = _reliable(hessian.sum(axis=0), whole)
        by = kept @ by
        rows.append((np.full(len(named), place), named, by.T @ hessian @ by, gradient @ by))
    places, cells, hessians, gradients = map(np.concatenate, zip(*rows, strict=True))
    row = np.unique(places * _PLACE_NUMBER + cells, return_inverse=True)[1]
    return Sums(_added(row.ravel(), hessians), _added(row.ravel(), gradients), metric)


def step_twists(T_base_lidar: Array) -> Array:
    """(6 k, 6 k) twists of (k, 4, 4) LiDARs about the base's origin, by their steps.

    A step is a rotation about the LiDAR's own position, and a shift.
    """
    shifts = np.tile(np.eye(4), (len(T_base_lidar), 1, 1))
    shifts[:, :3, 3] = T_base_lidar[:, :3, 3]
    return np.asarray(scipy.linalg.block_diag(*adjoints(shifts)))


def _of_pair(
    own: Matches, cells: NDArray[np.int64], one: int, scale_m: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Numbers of cells (c,), their H (c, 8, 8) and g (c, 8).

    By the twist of one against the other, and by what is added to the ranges of one and of the
    other. And H of all, (8, 8), as if normals did not err. Matches are sorted by their cells (m,).
    """
    plane, other, (by_other, by_own) = own["plane"], own["of_other"], residuals_m(own)
    weight = 1.0 / (1.0 + 0.5 * (by_other**2 + by_own**2) / scale_m**2)
    is_one = (own["one"] == one)[:, None]
    rays = (
        np.where(is_one, plane["ray"], other["ray"]),
        -np.where(is_one, other["ray"], plane["ray"]),
    )
    a, b = (
        np.hstack([np.cross(at["center_m"], normal), normal,
                   *((normal * ray).sum(axis=1, keepdims=True) for ray in rays)])
        for at, normal in ((plane, other["normal"]), (other, plane["normal"]))
    )  # fmt: skip
    whole = 0.5 * ((a.T * weight) @ a + (b.T * weight) @ b)
    every, x = np.zeros((len(own), 3, 8)), plane["center_m"]  # A'
    every[:, [0, 1, 2], [1, 2, 0]], every[:, [0, 1, 2], [2, 0, 1]] = (
        x[:, [2, 0, 1]],
        -x[:, [1, 2, 0]],
    )
    every[:, :, 3:6], every[:, :, 6], every[:, :, 7] = np.eye(3), *rays
    shared = 0.5 * (plane["tilt"] ** 2 + other["tilt"] ** 2)[:, None]
    each = (b + shared * a)[:, :, None] * a[:, None, :]
    each -= every.transpose(0, 2, 1) @ (shared[:, :, None] * every)
    each *= (0.5 * weight)[:, None, None]
    starts = np.flatnonzero(np.diff(cells, prepend=cells[0] - 1))
    hessian = np.add.reduceat(each, starts)
    hessian += hessian.transpose(0, 2, 1)
    gradient = 0.5 * (b * by_other[:, None] + a * by_own[:, None])
    gradient *= weight[:, None] * np.where(is_one, 1.0, -1.0)
    return cells[starts], hessian, np.add.reduceat(gradient, starts), whole


def _added(rows: NDArray[np.int64], values: Array) -> Array:
    """The sums of values with equal row."""
    order = np.argsort(rows, kind="stable")
    starts = np.flatnonzero(np.diff(rows[order], prepend=-1))
    return np.asarray(np.add.reduceat(values[order], starts, axis=0))


def _reliable(hessian: Array, whole: Array) -> Array:
    """(8, 8) projection onto directions in which normals hold, along the others.

    First of twists alone: of what no normal shows, ranges would tell by the normals' errors.
    """
    whole, poses = _ridged(whole), slice(6)
    values, vectors = scipy.linalg.eigh(hessian[poses, poses], whole[poses, poses])
    others = vectors[:, values <= _RELIABLE].T @ whole[poses]
    of = scipy.linalg.null_space(others) if len(others) else np.eye(len(whole))
    values, vectors = scipy.linalg.eigh(of.T @ hessian @ of, of.T @ whole @ of)
    kept = of @ vectors[:, values > _RELIABLE]
    return np.asarray(kept @ kept.T @ whole)


def _ridged(whole: Array) -> Array:
    """A sum that is positive definite: of exact planes it may be singular."""
    ridge = _RIDGE * np.diag(whole).max() + np.finfo(float).tiny
    return np.asarray(whole + ridge * np.eye(len(whole)))
