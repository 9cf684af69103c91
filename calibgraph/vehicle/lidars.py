"""LiDARs relative to a base LiDAR: planes of each matched with planes of all others, at once.

With T_i = T_base_lidar of LiDAR i, a plane (c, n) of i and one (d, m) of j, the residual is
m . (T_i c - T_j d) in the base frame. The steps xi of T = exp(xi) estimate have the Jacobian
[(T_i c) x m, m] for i, and its negative for j. All LiDARs and places are one system of normal
equations, so loops close by construction.

Residuals of one surface err alike: the gradients of cells of ``CELL_M`` are the independent units,
and the covariance is H^-1 (sum g g^T) H^-1 over cells. Where there are several places, each is
fitted alone about the joint estimate; if they differ by more than their covariances say, all bars
widen by what they differ.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.vehicle.planes import Planes, find_planes

CELL_M = 2.0
"""Edge of the cells whose residuals count as one."""

_GATES_M = (1.0, 0.5, 0.3, 0.2)  # of the residuals, while the poses converge
_LAST_GATE_M, _MOST_ROUNDS = 0.1, 20
_COARSE_COSINE, _FINE_COSINE = np.cos(np.radians([35.0, 20.0]))  # of two normals of one plane
_LEAST_SCALE_M = 0.003  # of the Cauchy loss: simulated scans have none
_CONVERGED = 1e-6  # rad and m
_REACH_M = 3.0  # between the centres of two pieces of one plane
_LEAST_MATCHES = 100
_DETERMINED = 1e-9  # smallest eigenvalue of the unit-diagonal information
_PRIOR_PLACES = 1.0  # places that scatter as the cells say, in the mean

Clouds = Mapping[str, Sequence[Array]]
"""Per LiDAR its clouds (n, 3+) in its own frame [m], one of each instant; the same instants."""


@dataclass(frozen=True, eq=False)
class LidarCalibration:
    """LiDARs relative to the base.

    Attributes:
        base: its name.
        T_base_lidar: per LiDAR, (4, 4): p_base = T_base_lidar * p_lidar.
        covariance: per LiDAR but the base, (6, 6) of xi in T_base_lidar = exp(xi) estimate,
            xi = (rotation [rad], translation [m]) in the base's axes.
        joint_covariance: (6 k, 6 k) of them all, in their order.
        matches: per LiDAR, matched planes.
        place_ratio: variance of what places differ over what their covariances say; 1 of one place.
    """

    base: str
    T_base_lidar: Mapping[str, Array]
    covariance: Mapping[str, Array]
    joint_covariance: Array
    matches: Mapping[str, int]
    place_ratio: float


@dataclass(frozen=True, eq=False)
class _Matches:
    """Matched planes of two LiDARs at one place.

    Attributes:
        place: its number.
        one, other: numbers of the LiDARs.
        jacobian: (m, 6) of the residuals, by the step of the one; the other's is its negative.
        residuals_m: (m,).
        cells: (m, 3) numbers of cells.
    """

    place: int
    one: int
    other: int
    jacobian: Array
    residuals_m: Array
    cells: NDArray[np.int64]


def calibrate_lidars(
    clouds: Clouds, T_base_lidar: Mapping[str, Array], *, base: str
) -> LidarCalibration:
    """The poses of LiDARs from what they see in common, at all instants at once.

    The vehicle stands at each instant, or the clouds have been brought to one time.

    Args:
        clouds: of at least two LiDARs, the base among them.
        T_base_lidar: (4, 4) the guess of each but the base, within some 5 degrees and half a metre.
        base: name of the LiDAR in whose frame the others are.

    Raises:
        CalibrationError: if LiDARs see too little in common, or leave a direction free.
        ValueError: if names or counts of clouds do not fit.
    """
    names = [base, *(name for name in clouds if name != base)]
    _require_alike(clouds, T_base_lidar, names)
    planes = [[find_planes(cloud) for cloud in clouds[name]] for name in names]
    T = np.array([np.eye(4), *(np.asarray(T_base_lidar[name], np.float64) for name in names[1:])])
    for number in range(_MOST_ROUNDS):
        is_last = number >= len(_GATES_M)
        gate_m = _LAST_GATE_M if is_last else _GATES_M[number]
        matches = _match(planes, T, gate_m, _FINE_COSINE if number > 1 else _COARSE_COSINE)
        counts = _require_overlap(matches, names)
        weights, scale_m = _weigh(matches)
        hessian, gradient = _equations(matches, weights, len(names))
        step = -np.linalg.solve(_require_determined(hessian, names), gradient)
        moved = step.reshape(-1, 6)
        T[1:] = [gtsam.Pose3.Expmap(xi).matrix() @ of for xi, of in zip(moved, T[1:], strict=True)]
        if is_last and np.abs(step).max() < _CONVERGED:
            break
    joint, ratio = _covariance(matches, weights, scale_m, len(names))
    rows = [slice(6 * row, 6 * row + 6) for row in range(len(names) - 1)]
    own = {name: joint[of, of] for name, of in zip(names[1:], rows, strict=True)}
    return LidarCalibration(base, dict(zip(names, T, strict=True)), own, joint, counts, ratio)


def _require_alike(clouds: Clouds, guess: Mapping[str, Array], names: Sequence[str]) -> None:
    if names[0] not in clouds or len(names) == 1:
        raise ValueError(f"clouds of {', '.join(clouds)}: of the base {names[0]} and another")
    if missing := [name for name in names[1:] if name not in guess]:
        raise ValueError(f"T_base_lidar has no guess of {', '.join(missing)}")
    counts = {name: len(clouds[name]) for name in names}
    if len({*counts.values()}) > 1:
        raise ValueError(f"clouds of the same instants are needed; found {counts}")


def _match(
    planes: Sequence[Sequence[Planes]], T_base_lidar: Array, gate_m: float, cosine: float
) -> list[_Matches]:
    """Each plane with the nearest one of every other LiDAR, if that can be the same."""
    found = []
    for place, seen in enumerate(zip(*planes, strict=True)):
        here = [own.moved(T) for own, T in zip(seen, T_base_lidar, strict=True)]
        trees = [cKDTree(own.centers_m) if len(own) else None for own in here]
        for one, other in permutations(range(len(here)), 2):
            tree, of, to = trees[other], here[one], here[other]
            if tree is None or not len(of):
                continue
            away, nearest = tree.query(of.centers_m, distance_upper_bound=_REACH_M)
            rows = np.flatnonzero(np.isfinite(away))
            of, to = of.select(rows), to.select(nearest[rows])
            apart = of.centers_m - to.centers_m
            across = (to.normals * apart).sum(axis=1)
            along = np.sqrt(np.maximum((apart**2).sum(axis=1) - across**2, 0.0))
            same = (along < np.maximum(of.radii_m, to.radii_m)) & (np.abs(across) < gate_m)
            same &= (of.normals * to.normals).sum(axis=1) > cosine
            of, to = of.select(same), to.select(same)
            jacobian = np.hstack([np.cross(of.centers_m, to.normals), to.normals])
            cells = np.floor(of.centers_m / CELL_M).astype(np.int64)
            found.append(_Matches(place, one, other, jacobian, across[same], cells))
    return found


def _require_overlap(matches: Sequence[_Matches], names: Sequence[str]) -> dict[str, int]:
    """Per LiDAR its matches; one line if one has too few."""
    counts = dict.fromkeys(names, 0)
    for own in matches:
        for number in (own.one, own.other):
            counts[names[number]] += len(own.residuals_m)
    for name, count in counts.items():
        if count < _LEAST_MATCHES:
            raise CalibrationError(
                f"LiDAR {name!r} sees {count} planes that others see, at least {_LEAST_MATCHES} "
                "are needed; check its guess T_base_lidar (p_base = T_base_lidar * p_lidar), or "
                "record where walls and ground are in view of both"
            )
    return counts


def _weigh(matches: Sequence[_Matches]) -> tuple[list[Array], float]:
    """Weights of the residuals in a Cauchy loss as wide as they spread, and that width."""
    every = np.concatenate([own.residuals_m for own in matches])
    scale_m = max(2.0 * 1.4826 * float(np.median(np.abs(every))), _LEAST_SCALE_M)
    return [1.0 / (1.0 + (own.residuals_m / scale_m) ** 2) for own in matches], scale_m


def _full(own: _Matches, lidars: int) -> Array:
    """(m, 6 k) Jacobian by all LiDARs but the base."""
    full = np.zeros((len(own.residuals_m), lidars, 6))
    full[:, own.one] += own.jacobian
    full[:, own.other] -= own.jacobian
    return full[:, 1:].reshape(len(full), -1)


def _equations(
    matches: Sequence[_Matches], weights: Sequence[Array], lidars: int
) -> tuple[Array, Array]:
    """(6 k, 6 k) H and (6 k,) g of the normal equations."""
    size = 6 * (lidars - 1)
    hessian, gradient = np.zeros((size, size)), np.zeros(size)
    for own, weight in zip(matches, weights, strict=True):
        weighted = _full(own, lidars) * weight[:, None]
        hessian += weighted.T @ _full(own, lidars)
        gradient += own.residuals_m @ weighted
    return hessian, gradient


def _require_determined(hessian: Array, names: Sequence[str]) -> Array:
    units = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(hessian / np.outer(units, units))
    if values[0] < _DETERMINED:
        loose = names[1 + int(np.argmax(np.abs(vectors[:, 0]))) // 6]
        raise CalibrationError(
            f"LiDAR {loose!r}: the planes that it shares with others leave a direction free; record "
            "where surfaces of three directions are in view, such as ground and two walls"
        )
    return hessian


def _covariance(
    matches: Sequence[_Matches], weights: Sequence[Array], scale_m: float, lidars: int
) -> tuple[Array, float]:
    """(6 k, 6 k) covariance by cells and places, and the variance ratio of places."""
    places = sorted({own.place for own in matches})
    hessians, scatters, gradients = [], [], []
    for place in places:
        own = [(of, by) for of, by in zip(matches, weights, strict=True) if of.place == place]
        hessian, gradient = _equations(*zip(*own, strict=True), lidars)  # type: ignore[arg-type]
        pulls = np.concatenate([_full(of, lidars) * (by * of.residuals_m)[:, None] for of, by in own])
        cells = np.unique(np.concatenate([of.cells for of, _ in own]), axis=0, return_inverse=True)
        sums = np.zeros((len(cells[0]), pulls.shape[1]))
        np.add.at(sums, cells[1].ravel(), pulls)
        hessians.append(hessian)
        gradients.append(gradient)
        scatters.append(sums.T @ sums)
    inverse = np.linalg.inv(sum(hessians))
    joint = inverse @ sum(scatters) @ inverse
    ratio = _place_ratio(np.array(hessians), np.array(gradients), np.array(scatters))
    return joint * ratio, ratio


def _place_ratio(hessians: Array, gradients: Array, scatters: Array) -> float:
    """At least 1: the squared gradients of places over the scatter of their cells.

    At the joint estimate the gradients of places add up to zero: of P places they have P - 1 times
    as many degrees of freedom as there are unknowns that a place determines.
    """
    count, size = gradients.shape
    if count == 1:
        return 1.0
    inverse = [np.linalg.pinv(scatter, rcond=1e-10, hermitian=True) for scatter in scatters]
    squared = sum(float(g @ of @ g) for g, of in zip(gradients, inverse, strict=True))
    prior = _PRIOR_PLACES * size
    return max(1.0, (prior + squared) / (prior + (count - 1) * size))
