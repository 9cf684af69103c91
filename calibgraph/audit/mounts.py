"""Spreads, centres and moved cameras of one model of vehicle, learnt by EM (REML)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.audit.model import Posterior, weigh, weighted_mean
from calibgraph.audit.observations import Observations
from calibgraph.model.geometry import retract_all, twists_between

MIN_VEHICLES = 8
"""Measured vehicles from which a camera's spread is learnt: six axes need more than six."""

_PSEUDO_VEHICLES = 4.0
"""Added with the spread along each axis alone: correlations of few vehicles are not believed."""

_MAX_ITERATIONS, _TOLERANCE = 300, 1e-3  # relative change of the spread; its own error is over 1 %


@dataclass(frozen=True)
class Pooled:
    """What the cameras of a model share. Variances are multiples of a camera's own spread.

    Each starts from, and is pulled with the weight of one camera (a share: of 50) towards, its
    default.

    Attributes:
        moved: variance of moved cameras, at least that of three standard deviations.
        batch: variance of a batch about the nominal pose.
        batch_moved: variance of a batch whose mount was changed.
        share_moved: of the cameras.
        share_batches: of the batches that were changed.
    """

    moved: float = 100.0
    batch: float = 0.1
    batch_moved: float = 2.0
    share_moved: float = 0.02
    share_batches: float = 0.02

    def batch_spreads(self, spread: Array) -> Array:
        """(2, 6, 6) of batches as they are and of changed ones."""
        return np.array([[[self.batch]], [[self.batch_moved]]]) * shapes(spread)

    def spreads(self, spread: Array) -> Array:
        """(2, 6, 6) of cameras in their mounts and of moved ones."""
        return np.array([[[1.0]], [[self.moved]]]) * shapes(spread)


def shapes(spread: Array) -> Array:
    """(2, 6, 6) of both cases: a camera that is moved goes along any axis, as far as that varies.

    Args:
        spread: (6, 6) of the cameras in their mounts.
    """
    return np.array([spread, np.diag(np.diag(spread))])


@dataclass(frozen=True, eq=False)
class Centers:
    """Where a camera sits in a model of vehicle and in each of its batches.

    Attributes:
        nominal: (4, 4) T_camera_lidar of the model.
        nominal_covariance: (6, 6) of xi in T_camera_lidar = exp(xi) estimate.
        batches: (b, 4, 4).
        batch_covariance: (b, 6, 6).
    """

    nominal: Array
    nominal_covariance: Array
    batches: Array
    batch_covariance: Array


Batches = tuple[NDArray[np.intp], Array, Array]
"""What the vehicles alone measure: (m,) batches, (m, 4, 4) their poses, (m, 6, 6) covariances."""


def solve_centers(start: Centers, measured: Batches, spread: Array) -> Centers:
    """Nominal pose and batches: a batch scatters about the nominal pose by (b, 6, 6) ``spread``."""
    some, T, noise = measured
    y = twists_between(T, start.nominal)
    total: Array = np.asarray(np.linalg.inv(spread[some] + noise), np.float64)
    center, of_center = weighted_mean(y, total)
    gain, rest = np.zeros_like(spread), np.tile(np.eye(6), (len(spread), 1, 1))
    gain[some] = spread[some] @ total
    rest -= gain
    steps = np.tile(center, (len(spread), 1))
    steps[some] += np.einsum("bij,bj->bi", gain[some], y - center)
    starts = np.tile(start.nominal, (len(spread) + 1, 1, 1))
    poses = retract_all(starts, -np.vstack([center, steps]))
    bars = rest @ spread + rest @ of_center @ rest.swapaxes(1, 2)
    return Centers(poses[0], of_center, poses[1:], (bars + bars.swapaxes(1, 2)) / 2)


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera in all vehicles of a model.

    Attributes:
        model, camera: names.
        batches: names.
        batch: (n,) index of each vehicle's.
        seen: the vehicles' observations.
        centers: nominal pose and batches.
        spread: (6, 6) covariance of a vehicle's deviation from its batch.
    """

    model: str
    camera: str
    batches: tuple[str, ...]
    batch: NDArray[np.intp]
    seen: Observations
    centers: Centers
    spread: Array

    def deviations(self) -> Array:
        """(n, 6) measured, from each vehicle's batch; zero where nothing is."""
        y = twists_between(self.seen.T_camera_lidar, self.centers.batches[self.batch])
        return np.where(self.seen.measured[:, None], y, 0.0)

    def measured_batches(self, vehicles: Posterior) -> Batches:
        """What the vehicles alone measure of the batches' centres, by sums over vehicles."""
        information = np.zeros((len(self.batches), 6, 6))
        weighted = np.zeros((len(self.batches), 6))
        each = np.einsum("nij,nj->ni", vehicles.information, self.deviations())
        np.add.at(information, self.batch, vehicles.information)
        np.add.at(weighted, self.batch, each)
        some = np.flatnonzero(np.trace(information, axis1=1, axis2=2) > 0)
        covariance = np.linalg.inv(information[some])
        covariance = (covariance + covariance.swapaxes(1, 2)) / 2
        steps = np.einsum("bij,bj->bi", covariance, weighted[some])
        return some, retract_all(self.centers.batches[some], -steps), covariance

    def of_all(self, rows: Observations, pooled: Pooled) -> Mount:
        """The same mount with other rows; unmeasured batches have the model's nominal pose."""
        known = np.searchsorted(self.batches, rows.batch).clip(max=len(self.batches) - 1)
        batch = np.where(np.array(self.batches)[known] == rows.batch, known, len(self.batches))
        new = self.centers.nominal_covariance + pooled.batch * self.spread
        centers = replace(
            self.centers,
            batches=np.concatenate([self.centers.batches, self.centers.nominal[None]]),
            batch_covariance=np.concatenate([self.centers.batch_covariance, new[None]]),
        )
        return replace(self, batches=(*self.batches, ""), batch=batch, seen=rows, centers=centers)

    def shrink(self, pooled: Pooled) -> tuple[Array, Array]:
        """(n, 4, 4) T_camera_lidar of the vehicles, and (n, 6, 6) their covariances."""
        around = self.centers.batch_covariance[self.batch]
        mean, covariance = self.weigh(pooled).deviations(self.deviations(), around)
        return retract_all(self.centers.batches[self.batch], -mean), covariance

    def weigh(self, pooled: Pooled) -> Posterior:
        """The vehicles' deviations, given their measurements."""
        spreads = pooled.spreads(self.spread)
        return weigh(self.deviations(), self.seen.covariance, spreads, pooled.share_moved)


@dataclass(frozen=True)
class Moments:
    """Sums over vehicles, or over batches, of both cases: regular first.

    Attributes:
        counts: (2,) expected number of each case.
        squares: (2,) expected sums of squared deviations over the spread of :func:`shapes`.
    """

    counts: Array
    squares: Array

    def variances(self, defaults: Sequence[float]) -> Array:
        """(2,) variances of both cases, their defaults with the weight of one."""
        variances: Array = (6 * np.array(defaults) + self.squares) / (6 * (1 + self.counts))
        return variances

    def share(self, default: float) -> float:
        """The share of the second case, its default with the weight of 50."""
        return float((50 * default + self.counts[1]) / (50 + self.counts.sum()))


def moments_of(posterior: Posterior, moments: Array, spread: Array) -> Moments:
    """The sums of deviations with (2, n, 6, 6) second moments."""
    squares = np.einsum("kij,knji->kn", np.linalg.inv(shapes(spread)), moments)
    share = posterior.share
    return Moments(share.sum(axis=1), (share * squares).sum(axis=1))


def fit_mounts(observations: Observations) -> tuple[list[Mount], Pooled]:
    """The mounts of one model's cameras that enough vehicles measured."""
    usable = observations.select(observations.measured)
    names, counts = np.unique(usable.camera, return_counts=True)
    mounts = [start_mount(usable.select(usable.camera == name))
              for name in names[counts >= MIN_VEHICLES]]  # fmt: skip
    pooled = Pooled()
    for _ in range(_MAX_ITERATIONS if mounts else 0):
        steps = [improve(mount, pooled) for mount in mounts]
        change = max(_relative_change(mount.spread, step[0].spread)
                     for mount, step in zip(mounts, steps, strict=True))  # fmt: skip
        mounts = [step[0] for step in steps]
        pooled = pool([step[1] for step in steps], [step[2] for step in steps])
        if change < _TOLERANCE:
            break
    return mounts, pooled


def start_mount(seen: Observations) -> Mount:
    """One camera's mount by medians over all vehicles, from which EM starts."""
    nominal = seen.T_camera_lidar[0]
    for _ in range(3):  # the medians are of tangents, so the point of tangency follows them
        y = twists_between(seen.T_camera_lidar, nominal)
        nominal = retract_all(nominal[None], -np.median(y, axis=0)[None])[0]
    y = twists_between(seen.T_camera_lidar, nominal)
    variance = (np.median(np.abs(y), axis=0) / 0.6745) ** 2  # of a Gaussian: the median is 0.6745
    noise = np.median(np.diagonal(seen.covariance, axis1=1, axis2=2), axis=0)
    spread = np.diag(np.maximum(variance - noise, 0.1 * variance) + np.finfo(float).eps)
    names, batch = np.unique(seen.batch, return_inverse=True)
    centers = Centers(nominal, spread, np.repeat(nominal[None], len(names), axis=0),
                      np.repeat(spread[None], len(names), axis=0))  # fmt: skip
    return Mount(str(seen.model[0]), str(seen.camera[0]), tuple(map(str, names)), batch, seen,
                 centers, spread)  # fmt: skip


def improve(mount: Mount, pooled: Pooled) -> tuple[Mount, Moments, Moments]:
    """One iteration of EM: the mount, and the sums of its vehicles and of its batches."""
    vehicles = mount.weigh(pooled)
    measured = mount.measured_batches(vehicles)
    y = twists_between(measured[1], mount.centers.nominal)
    spreads = pooled.batch_spreads(mount.spread)
    batches = weigh(y, measured[2], spreads, pooled.share_batches)
    centers = solve_centers(mount.centers, measured, _between(mount, pooled, measured[0], batches))
    moved = replace(mount, centers=centers)
    own = vehicles.second_moments(moved.deviations(), centers.batch_covariance[mount.batch])
    y = twists_between(measured[1], centers.nominal)
    of_batches = batches.second_moments(y, centers.nominal_covariance[None])
    sums = moments_of(vehicles, own, mount.spread), moments_of(batches, of_batches, mount.spread)
    return replace(moved, spread=_spread(vehicles.share[0], own[0])), *sums


def _spread(share: Array, moments: Array) -> Array:
    """(6, 6) covariance of the regular deviations."""
    spread = np.einsum("n,nij->ij", share, moments) / share.sum()
    weight = _PSEUDO_VEHICLES / (_PSEUDO_VEHICLES + share.sum())
    spread = (1 - weight) * spread + weight * np.diag(np.diag(spread))
    return np.asarray((spread + spread.T) / 2)


def _between(mount: Mount, pooled: Pooled, some: NDArray[np.intp], batches: Posterior) -> Array:
    """(b, 6, 6) each batch's spread about the nominal pose: by its expected precision."""
    share = np.repeat([[1.0 - pooled.share_batches], [pooled.share_batches]],
                      len(mount.batches), axis=1)  # fmt: skip
    share[:, some] = batches.share
    precision = np.linalg.inv(pooled.batch_spreads(mount.spread))
    return np.linalg.inv(np.einsum("kb,kij->bij", share, precision))


def pool(vehicles: Sequence[Moments], batches: Sequence[Moments]) -> Pooled:
    """What the cameras of a model share, from the sums of each."""
    start = Pooled()
    of_vehicles, of_batches = (
        Moments(np.sum([each.counts for each in all_], axis=0),
                np.sum([each.squares for each in all_], axis=0))
        for all_ in (vehicles, batches)
    )  # fmt: skip
    batch, batch_moved = of_batches.variances([start.batch, start.batch_moved])
    return Pooled(
        moved=max(9.0, of_vehicles.variances([1.0, start.moved])[1]),
        batch=float(batch),
        batch_moved=max(9.0 * float(batch), float(batch_moved)),
        share_moved=of_vehicles.share(start.share_moved),
        share_batches=of_batches.share(start.share_batches),
    )


def _relative_change(before: Array, after: Array) -> float:
    """Largest relative change of a variance."""
    return float((np.abs(np.diag(after) / np.diag(before) - 1)).max())
