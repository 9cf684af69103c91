"""LiDARs relative to a base LiDAR: planes of each matched with planes of all others, at once.

All LiDARs and places are one system of sums (``sums.py``), so loops close by construction. At each
place p the LiDARs stand at theta + u_p, u_p ~ N(0, D): what a place does to all its planes alike,
such as points of other times. With H_p, g_p of a place and S_p, the scatter of its cells'
gradients, it has the information I_p = H_p S_p^-1 H_p about theta + u_p, and u_p is eliminated as
a camera's places are: the sum of I_p - I_p (I_p + D^-1)^-1 I_p is the information about theta. The
sizes in D are REML estimates (Schall), about a prior. Errors over their own estimated size scatter
more than over the true one, (1 + 2 f / (f + f_0)^2) with f degrees of freedom and f_0 of the prior:
the covariance is wider by that.

Ranges of a LiDAR may all be too long by so much. What is to be added to each is a column as well,
with a prior, that all places share: where walls ahead and beside show it, it is estimated, else the
covariance of poses is wider by it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError
from calibgraph.model.geometry import rows_of_poses
from calibgraph.vehicle.planes import Planes, Views, lengthened, moved
from calibgraph.vehicle.sums import MATCH, Matches, Sums, residuals_m, sum_up

_GATES_M = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.13)  # of the residuals, while the poses converge
_LAST_GATE_M, _MOST_ROUNDS = 0.1, 25
_AT_PLACE = 2  # number of the gate from which a place is fitted alone
_WIDTH = 0.5  # of the Cauchy loss over the gate, at least, while the poses converge
_COARSE_COSINE, _FINE_COSINE = np.cos(np.radians([35.0, 20.0]))  # of two normals of one plane
_LEAST_SCALE_M = 0.003  # of the Cauchy loss: simulated scans have none
_CONVERGED = 1e-6  # rad and m
_REACH_M = 3.0  # between the centres of two pieces of one plane
_LEAST_MATCHES = 100
_STANDS = 0.95  # share of upright planes in place from which the vehicle has not moved
_UPRIGHT = np.cos(np.radians(45.0))  # of a normal against up: below, the plane is upright

PLACE_SIGMAS = np.repeat([np.radians(0.1), 0.015], 3)
"""(6,) [rad, m]: prior of what a LiDAR's pose differs between places, beyond what cells show: a car
whose clouds are 10 ms apart at 1.5 m/s. Results of tilted domes differ by 1 to 2 cm, 0.2 deg."""
PLACE_FREEDOM = 1.0
"""Degrees of freedom of that prior. Of three places that scatter by half of it or by twice as much,
errors have squares of 0.6 to 1.3 of the variance; with 3 it is 0.4 to 1.6."""
GUESS_SIGMAS = np.repeat([np.radians(10.0), 1.0], 3)
"""(6,) [rad, m] of a direction that no plane determines."""
RANGE_SIGMA_M = 0.01
"""Standard deviation of what a LiDAR adds to all its ranges: data sheets state 1 to 3 cm."""
_SAME_OFFSET_M, _MOST_OFFSETS = 0.002, 4  # a change of it that ends the rounds, and most rounds
_EXACT = 1e-18  # [m^2, rad^2] least variance, for rounding
_LEAST_VARIANCE = 1e-9  # [m^2] of residuals: without, exact scans determine more than numbers hold
_SETTLED, _MOST_STEPS = 0.01, 50  # of REML


@dataclass(frozen=True, eq=False)
class LidarPoses:
    """LiDARs relative to the base.

    Attributes:
        base: its name.
        T_base_lidar: per LiDAR, (4, 4): p_base = T_base_lidar * p_lidar.
        joint_covariance: (6 k, 6 k) of all but the base, in their order.
        matched: per LiDAR, the share of its planes near others' that lie on them (0-1); not of one
            that cameras place.
        places: instants between which the vehicle has moved.
        place_ratios: variance of rotation and translation between places over its prior.
        longer_m: per LiDAR on planes, by how much it measures longer ranges than the base, and the
            sigma of that.
    """

    base: str
    T_base_lidar: Mapping[str, Array]
    joint_covariance: Array
    matched: Mapping[str, float]
    places: int
    place_ratios: tuple[float, float]
    longer_m: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def covariance(self) -> dict[str, Array]:
        """Per LiDAR but the base, (6, 6) of xi = (rotation [rad], translation [m]).

        In the base's axes: R = exp(rotation) R_estimate, t = t_estimate + translation, t being the
        position of the LiDAR.
        """
        names = [name for name in self.T_base_lidar if name != self.base]
        blocks = self.joint_covariance.reshape(len(names), 6, len(names), 6)
        return {name: blocks[row, :, row] for row, name in enumerate(names)}

    @property
    def root(self) -> Array:
        """(6 k, 6 k) Cholesky root of the joint covariance."""
        return np.asarray(
            np.linalg.cholesky(self.joint_covariance + _EXACT * np.eye(6 * len(self.covariance)))
        )


def calibrate_lidars(
    views: Views, T_base_lidar: Mapping[str, Array], *, base: str,
    place_sigmas: Array = PLACE_SIGMAS,
) -> LidarPoses:  # fmt: skip
    """The poses of LiDARs from what they see in common, at all instants at once.

    The vehicle stands at each instant, or the clouds have been brought to one time. Of instants
    between which it has not moved the first is taken: their errors are the same.

    Args:
        views: of at least two LiDARs, the base among them.
        T_base_lidar: (4, 4) the guess of each but the base, within some 5 degrees and half a metre.
        base: name of the LiDAR in whose frame the others are.
        place_sigmas: (6,) prior of what a pose differs between places.

    Raises:
        CalibrationError: if LiDARs see too little in common.
    """
    names = [base, *(name for name in views if name != base)]
    planes = [[view.planes for view in views[name]] for name in names]
    kept = _distinct(planes[0])
    planes = [[of[i] for i in kept] for of in planes]
    T = np.array([np.eye(4), *(np.asarray(T_base_lidar[name], np.float64) for name in names[1:])])
    added_m, first, poses = np.zeros(len(names)), 0, 6 * len(names) - 6
    for _ in range(_MOST_OFFSETS):
        at = [
            [lengthened(own, metres) for own in of]
            for of, metres in zip(planes, added_m, strict=True)
        ]
        T, _ = refine_poses(at, T, names, first=first)
        places = [_at_place([of[i : i + 1] for of in at], T, names) for i in range(len(kept))]
        step, joint, ratios = combine_places(places, place_sigmas, added_m)
        T, first = _stepped(T, step[:poses]), _AT_PLACE
        added_m = added_m + step[poses:]
        if np.abs(step[poses:]).max() < _SAME_OFFSET_M:
            break
    near, on = count_matched(at, T)
    against = np.hstack([np.ones((len(names) - 1, 1)), -np.eye(len(names) - 1)])  # the base
    sigmas_m = np.sqrt(np.diag(against @ joint[poses:, poses:] @ against.T))
    longer_m = zip((against @ added_m).tolist(), sigmas_m.tolist(), strict=True)
    return LidarPoses(
        base,
        dict(zip(names, T, strict=True)),
        joint[:poses, :poses],
        dict(zip(names, (on / near).tolist(), strict=True)),
        len(places),
        ratios,
        dict(zip(names[1:], longer_m, strict=True)),
    )


def join_poses(parts: Sequence[LidarPoses], names: Sequence[str]) -> LidarPoses:
    """Poses that were found independently of each other; where one is in several, the last counts.

    In the order of names, the base first.
    """
    of = {name: part for part in parts for name in part.covariance}
    joint = np.zeros((6 * len(of), 6 * len(of)))
    for part in parts:
        kept = [name for name in part.covariance if of[name] is part]
        to, rows = (rows_of_poses(kept, [*order]) for order in (names[1:], part.covariance))
        joint[np.ix_(to, to)] = part.joint_covariance[np.ix_(rows, rows)]
    return LidarPoses(
        names[0],
        {name: of[name].T_base_lidar[name] if name in of else np.eye(4) for name in names},
        joint,
        {name: part.matched[name] for name, part in of.items() if name in part.matched},
        min(part.places for part in parts),
        (max(p.place_ratios[0] for p in parts), max(p.place_ratios[1] for p in parts)),
        {name: part.longer_m[name] for name, part in of.items() if name in part.longer_m},
    )


def refine_poses(
    planes: Sequence[Sequence[Planes]],
    T_base_lidar: Array,
    names: Sequence[str],
    *,
    first: int = 0,
    rounds: int = _MOST_ROUNDS,
) -> tuple[Array, Sums]:
    """The (k, 4, 4) poses at which planes fit best, and the sums there; the base is the first.

    Raises:
        CalibrationError: if a LiDAR has too few matches.
    """
    T = T_base_lidar
    for number in range(first, rounds):
        is_last = number >= len(_GATES_M)
        gate_m = _LAST_GATE_M if is_last else _GATES_M[number]
        found, cosine = _nearest(planes, T), _FINE_COSINE if number > 1 else _COARSE_COSINE
        matches = found[_are_same(found, gate_m, cosine)]
        _require_overlap(matches, names)
        sums = sum_up(matches, T, _scale_m(matches, 0.0 if is_last else _WIDTH * gate_m))
        step = _step(sums.of_poses)
        T = _stepped(T, step)
        if is_last and np.abs(step).max() < _CONVERGED:
            break
    return T, sums


def _distinct(planes: Sequence[Planes]) -> list[int]:
    """The instants of which the base sees upright planes elsewhere than at those before."""
    kept: list[int] = []
    for number, own in enumerate(planes):
        up = np.linalg.eigh(own["normal"].T @ own["normal"])[1][:, 2]  # most planes are ground
        stands = False
        for other in kept:
            near, on = count_matched([[planes[other]], [own]], np.array([np.eye(4)] * 2), up=up)
            stands |= bool(on[0] > _STANDS * max(near[0], 1.0))
        if not stands:
            kept.append(number)
    return kept


def _stepped(T_base_lidar: Array, steps: Array) -> Array:
    """(k, 4, 4) poses after (6 (k - 1),) steps of all but the base."""
    T = T_base_lidar.copy()
    for pose, step in zip(T[1:], steps.reshape(-1, 6), strict=True):
        pose[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix() @ pose[:3, :3]
        pose[:3, 3] += step[3:]
    return T


def _are_same(found: Matches, gate_m: float, cosine: float) -> NDArray[np.bool_]:
    """Which can be pieces of one plane."""
    plane, other = found["plane"], found["of_other"]
    apart = plane["center_m"] - other["center_m"]
    across = (other["normal"] * apart).sum(axis=1)
    along = np.sqrt(np.maximum((apart**2).sum(axis=1) - across**2, 0.0))
    same = (along < np.maximum(plane["radius_m"], other["radius_m"])) & (np.abs(across) < gate_m)
    return np.asarray(same & ((plane["normal"] * other["normal"]).sum(axis=1) > cosine))


def _nearest(planes: Sequence[Sequence[Planes]], T_base_lidar: Array) -> Matches:
    """Of each place and ordered pair of LiDARs, planes of one and the nearest of the other."""
    found = [np.empty(0, MATCH)]
    for place, seen in enumerate(zip(*planes, strict=True)):
        here = [moved(own, T) for own, T in zip(seen, T_base_lidar, strict=True)]
        trees = [cKDTree(own["center_m"], balanced_tree=False) for own in here]
        for one, other in permutations(range(len(here)), 2):
            away, nearest = trees[other].query(here[one]["center_m"], distance_upper_bound=_REACH_M)
            rows = np.flatnonzero(np.isfinite(away))
            own = np.empty(len(rows), MATCH)
            own["place"], own["one"], own["other"] = place, one, other
            own["plane"], own["of_other"] = here[one][rows], here[other][nearest[rows]]
            found.append(own)
    return np.concatenate(found)


def count_matched(
    planes: Sequence[Sequence[Planes]], T_base_lidar: Array, *, up: Array | None = None
) -> tuple[Array, Array]:
    """Per LiDAR (k,): planes whose centre another's plane is near, and how many lie on it.

    With (3,) ``up`` in the base frame only those that are upright.
    """
    found = _nearest(planes, T_base_lidar)
    plane, other = found["plane"], found["of_other"]
    apart = plane["center_m"] - other["center_m"]
    beside = (apart**2).sum(axis=1) < np.maximum(plane["radius_m"], other["radius_m"]) ** 2
    if up is not None:
        beside &= np.abs(plane["normal"] @ up) < _UPRIGHT
    on_it = beside & _are_same(found, _LAST_GATE_M, _FINE_COSINE)
    near, on = (_per_lidar(found[of], len(T_base_lidar)) for of in (beside, on_it))
    return near, on


def _per_lidar(matches: Matches, count: int) -> Array:
    """(k,) how many matches each LiDAR has a part in."""
    both = np.concatenate([matches["one"], matches["other"]])
    return np.bincount(both, minlength=count).astype(np.float64)


def _require_overlap(matches: Matches, names: Sequence[str]) -> None:
    """One line if a LiDAR has too few matches."""
    counts = _per_lidar(matches, len(names))
    for name, count in zip(names[::-1], counts[::-1], strict=True):  # the base shares with all
        if count < _LEAST_MATCHES:
            raise CalibrationError(
                f"LiDAR {name!r} sees {count:.0f} planes that others see, at least "
                f"{_LEAST_MATCHES} are needed; check its guess T_base_lidar (p_base = "
                "T_base_lidar * p_lidar), or record where walls and ground are in view of both"
            )


def _scale_m(matches: Matches, least_m: float) -> float:
    """Width of the Cauchy loss: as residuals spread."""
    spread_m = 1.4826 * float(np.median(np.abs(residuals_m(matches)[0])))
    return max(2.0 * spread_m, _LEAST_SCALE_M, least_m)


def _step(sums: Sums) -> Array:
    """(d,) Gauss-Newton, along what is determined."""
    basis = sums.basis()
    hessian = basis.T @ sums.hessian.sum(axis=0) @ basis
    return np.asarray(-basis @ np.linalg.solve(hessian, basis.T @ sums.gradient.sum(axis=0)))


def _at_place(
    planes: Sequence[Sequence[Planes]], T_base_lidar: Array, names: Sequence[str]
) -> tuple[Array, Array]:
    """(d, d) I_p and (d,) I_p (theta + u_p) of one place, in steps from poses near its optimum.

    The place is fitted alone. The scatter S_p is of its cells there, each with the weight of
    leaving it out (the jackknife): a direction that hangs by one cell is determined by none. A
    place with too few matches has no information.
    """
    size = 7 * len(names) - 6
    try:
        T, sums = refine_poses(planes, T_base_lidar, names, first=_AT_PLACE)
    except CalibrationError:
        return np.zeros((size, size)), np.zeros(size)
    basis, step = sums.basis(), _step(sums)
    whole = sums.hessian.sum(axis=0) @ basis  # (d, q)
    hessian, cells = basis.T @ whole, basis.T @ sums.hessian @ basis
    gradients = ((sums.gradient + sums.hessian @ step) @ basis)[:, :, None]
    apart = np.linalg.solve(hessian - cells, gradients)[:, :, 0]  # of a fit without the cell
    root = np.linalg.cholesky(_shrunk(apart, hessian) + _LEAST_VARIANCE * np.eye(len(hessian)))
    seen = np.linalg.solve(hessian, whole.T)
    by = scipy.linalg.solve_triangular(root, seen, lower=True)  # (q, d)
    poses = _steps_between(T_base_lidar, T)
    step[: len(poses)] += poses
    return by.T @ by, by.T @ by @ step


def _shrunk(apart: Array, hessian: Array) -> Array:
    """(q, q) covariance by the (n, q) deviations of fits without each cell.

    Of few cells its smallest eigenvalues are far too small. So it is shrunk towards that of
    independent residuals, H^-1, of the same mean size, which counts as twice as many cells as there
    are directions.
    """
    size, inverse = len(hessian), np.linalg.inv(hessian)
    each = np.einsum("ni,ij,nj->n", apart, hessian, apart)
    cells = each.sum() ** 2 / max(float((each**2).sum()), float(np.finfo(float).tiny))
    model = each.sum() / size * (inverse + inverse.T) / 2
    return np.asarray((cells * apart.T @ apart + 2 * size * model) / (cells + 2 * size))


def _steps_between(T_base_lidar: Array, others: Array) -> Array:
    """(d,) the steps of all but the base from (k, 4, 4) poses to others."""
    turns = others[1:, :3, :3] @ T_base_lidar[1:, :3, :3].transpose(0, 2, 1)
    shifts = others[1:, :3, 3] - T_base_lidar[1:, :3, 3]
    return np.column_stack([Rotation.from_matrix(turns).as_rotvec(), shifts]).ravel()


def combine_places(
    places: Sequence[tuple[Array, Array]], place_sigmas: Array, added_m: Array
) -> tuple[Array, Array, tuple[float, float]]:
    """(d,) step to the optimum over places, its (d, d) covariance, and the ratios of D.

    With (k,) what has been added to the ranges of each LiDAR.
    """
    informations, vectors = map(np.array, zip(*places, strict=True))
    size = len(vectors[0])
    lidars = (size - len(added_m)) // 6
    kinds = np.repeat([*[0, 1] * lidars, 2], [*[3] * 2 * lidars, len(added_m)])
    prior = np.concatenate([np.tile(place_sigmas**2, lidars), np.full(len(added_m), _EXACT)])
    ranges = np.full(len(added_m), RANGE_SIGMA_M**-2.0)
    guess = np.concatenate([np.tile(GUESS_SIGMAS**-2.0, lidars), ranges])
    pull = np.concatenate([np.zeros(6 * lidars), -ranges * added_m])
    ratios = np.ones(3)
    for _ in range(_MOST_STEPS):
        variance = prior * ratios[kinds]
        at_place = np.linalg.inv(informations + np.diag(1.0 / variance))
        gain = at_place @ informations
        known = (informations - informations @ gain).sum(axis=0) + np.diag(guess)
        vector = (vectors - (informations @ (at_place @ vectors[:, :, None]))[:, :, 0]).sum(axis=0)
        joint = np.linalg.inv(known)
        step = joint @ (vector + pull)
        apart = (at_place @ (vectors - informations @ step)[:, :, None])[:, :, 0]
        open_ = np.einsum("pii->pi", at_place + gain @ joint @ gain.transpose(0, 2, 1))
        squares, freedom = (
            np.array([of[:, kinds == 0].sum(), of[:, kinds == 1].sum(), 0.0])
            for of in (apart**2 / prior, 1.0 - open_ / variance)
        )
        before, ratios = ratios, (PLACE_FREEDOM + squares) / (PLACE_FREEDOM + freedom)
        if np.abs(np.log(ratios / before)).max() < _SETTLED:
            break
    wider = np.sqrt(1.0 + 2.0 * freedom / (PLACE_FREEDOM + freedom) ** 2)[kinds]
    joint = joint * np.outer(wider, wider)
    return step, (joint + joint.T) / 2, (float(ratios[0]), float(ratios[1]))
