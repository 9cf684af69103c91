"""What a fleet knows: the nominal pose of every camera, and every vehicle's deviation from it.

Vehicles of a model and batch scatter about the batch's nominal pose, batches about the model's.
Both spreads are learnt by EM (REML), and so is how many cameras were moved and how far.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.audit.model import Posterior, weigh, weighted_mean
from calibgraph.errors import CalibrationError
from calibgraph.model.geometry import retract_all, twists_between

FALSE_DISCOVERIES = 0.01
"""Expected share of wrong ones among everything that is flagged."""

_MIN_VEHICLES = 8
"""Measured vehicles from which a camera's spread is learnt: six axes need more than six."""

_PSEUDO_VEHICLES = 4.0
"""Added with the spread along each axis alone: correlations of few vehicles are not believed."""

_PSEUDO_CAMERAS = 50.0
"""Weight of the default of a share; variances have the weight of one camera."""

_MAX_ITERATIONS, _TOLERANCE = 300, 1e-3  # relative change of the spread; its own error is over 1 %


Batches = tuple[NDArray[np.intp], Array, Array]
"""Measured: (m,) indices of batches, (m, 4, 4) their poses, (m, 6, 6) covariances."""


@dataclass(frozen=True)
class Pooled:
    """What the cameras of a model share; each starts from, and is pulled towards, its default.

    Attributes:
        moved, batch, batch_moved: variances of moved cameras (at least that of three standard
            deviations), of a batch about the nominal pose, and of a batch whose mount was changed;
            multiples of a camera's own spread.
        share_moved, share_batches: of the cameras that were moved, and the batches changed.
    """

    moved: float = 100.0
    batch: float = 0.1
    batch_moved: float = 2.0
    share_moved: float = 0.02
    share_batches: float = 0.02


def both_cases(spread: Array, regular: float, moved: float) -> Array:
    """(2, 6, 6) spreads: what is moved goes along any axis, as far as that varies."""
    return np.array([regular * spread, moved * np.diag(np.diag(spread))])


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera in all vehicles of a model.

    Attributes:
        model, camera, batches: names.
        batch: (n,) index of each vehicle's.
        seen: the vehicles' observations.
        nominal: (4, 4) T_camera_lidar of the model.
        nominal_covariance: (6, 6) of xi in T_camera_lidar = exp(xi) nominal.
        T_batch: (b, 4, 4) T_camera_lidar of the batches.
        batch_covariance: (b, 6, 6).
        spread: (6, 6) covariance of a vehicle's deviation from its batch.
        pooled: what the model's cameras share.
    """

    model: str
    camera: str
    batches: tuple[str, ...]
    batch: NDArray[np.intp]
    seen: Observations
    nominal: Array
    nominal_covariance: Array
    T_batch: Array
    batch_covariance: Array
    spread: Array
    pooled: Pooled = Pooled()

    def deviations(self) -> Array:
        """(n, 6) measured, from each vehicle's batch; zero where nothing is."""
        y = twists_between(self.seen.T_camera_lidar, self.T_batch[self.batch])
        return np.where(self.seen.measured[:, None], y, 0.0)

    def weigh(self) -> Posterior:
        """The vehicles' deviations, given their measurements."""
        spreads = both_cases(self.spread, 1.0, self.pooled.moved)
        return weigh(self.deviations(), self.seen.covariance, spreads, self.pooled.share_moved)

    def measured_batches(self, information: Array) -> Batches:
        """The batches by the (n, 6, 6) information of vehicles alone."""
        total, weighted = np.zeros((len(self.batches), 6, 6)), np.zeros((len(self.batches), 6))
        np.add.at(total, self.batch, information)
        np.add.at(weighted, self.batch, np.einsum("nij,nj->ni", information, self.deviations()))
        some = np.flatnonzero(np.trace(total, axis1=1, axis2=2) > 0)
        covariance = np.linalg.inv(total[some])
        covariance = (covariance + covariance.swapaxes(1, 2)) / 2
        steps = np.einsum("bij,bj->bi", covariance, weighted[some])
        return some, retract_all(self.T_batch[some], -steps), covariance

    def of_all(self, rows: Observations) -> Mount:
        """The same mount with other rows; unmeasured batches have the model's nominal pose."""
        known = np.searchsorted(self.batches, rows.batch).clip(max=len(self.batches) - 1)
        batch = np.where(np.array(self.batches)[known] == rows.batch, known, len(self.batches))
        new = self.nominal_covariance + self.pooled.batch * self.spread
        T_batch = np.concatenate([self.T_batch, self.nominal[None]])
        covariance = np.concatenate([self.batch_covariance, new[None]])
        return replace(self, batches=(*self.batches, ""), batch=batch, seen=rows, T_batch=T_batch,
                       batch_covariance=covariance)  # fmt: skip

    def covariance_of_a_vehicle(self) -> Array:
        """(6, 6) of xi in T_camera_lidar = exp(xi) nominal, of a further one that is not moved."""
        return self.spread + (self.nominal_covariance + self.pooled.batch * self.spread)


@dataclass(frozen=True, eq=False)
class FleetModel:
    """All models of a fleet, and its vehicles as they follow from them.

    Attributes:
        observations: the rows.
        mounts: per model and camera that enough vehicles measured.
        T_camera_lidar: (n, 4, 4) shrunk estimate of each row; as measured where its mount is
            unknown.
        covariance: (n, 6, 6) of it.
        deviation: (n, 6) measured deviation from the nominal pose of its batch; NaN if unknown.
        moved: (n,) probability that the camera was moved in its mount; NaN if unknown.
    """

    observations: Observations
    mounts: Mapping[str, Mapping[str, Mount]]
    T_camera_lidar: Array
    covariance: Array
    deviation: Array
    moved: Array

    @cached_property
    def apart(self) -> NDArray[np.bool_]:
        """(n,) flagged rows: the most with an expected share of wrong ones of FALSE_DISCOVERIES."""
        known = self.observations.measured & np.isfinite(self.moved)
        wrong = np.where(known, 1.0 - self.moved, 1.0)
        order = np.argsort(wrong, kind="stable")
        expected = np.cumsum(wrong[order]) / np.arange(1, len(order) + 1)
        flagged = np.zeros(len(order), dtype=np.bool_)
        flagged[order[: np.count_nonzero(expected <= FALSE_DISCOVERIES)]] = True
        return flagged


def fit_fleet(observations: Observations) -> FleetModel:
    """The hierarchical model of a fleet, and its vehicles' cameras shrunk towards it.

    A measurement with a small error bar stays as it is; one with a large one moves to its batch.
    """
    models = {str(name): fit_mounts(observations.select(observations.model == name))
              for name in np.unique(observations.model)}  # fmt: skip
    T, covariance = observations.T_camera_lidar.copy(), observations.covariance.copy()
    deviation, moved = np.full((len(T), 6), np.nan), np.full(len(T), np.nan)
    for mount in (mount for mounts in models.values() for mount in mounts.values()):
        rows = np.flatnonzero(
            (observations.model == mount.model) & (observations.camera == mount.camera)
        )
        every = mount.of_all(observations.select(rows))
        posterior, deviation[rows] = every.weigh(), every.deviations()
        moved[rows] = posterior.share[1]
        around = every.batch_covariance[every.batch]
        mean, covariance[rows] = posterior.deviations(deviation[rows], around)
        T[rows] = retract_all(every.T_batch[every.batch], -mean)
    known = {name: mounts for name, mounts in models.items() if mounts}
    return FleetModel(observations, known, T, covariance, deviation, moved)


def fit_mounts(observations: Observations) -> dict[str, Mount]:
    """The mounts of one model's cameras that enough vehicles measured."""
    usable = observations.select(observations.measured)
    names, counts = np.unique(usable.camera, return_counts=True)
    mounts = [_start(usable.select(usable.camera == name))
              for name in names[counts >= _MIN_VEHICLES]]  # fmt: skip
    for _ in range(_MAX_ITERATIONS if mounts else 0):
        before, steps = mounts, [_improve(mount) for mount in mounts]
        pooled = _pool(*np.sum([sums for _, sums in steps], axis=0))
        mounts = [replace(mount, pooled=pooled) for mount, _ in steps]
        change = max(np.abs(np.diag(new.spread) / np.diag(old.spread) - 1).max()
                     for old, new in zip(before, mounts, strict=True))  # fmt: skip
        if change < _TOLERANCE:
            break
    return {mount.camera: mount for mount in mounts}


def _start(seen: Observations) -> Mount:
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
    return Mount(str(seen.model[0]), str(seen.camera[0]), tuple(map(str, names)), batch, seen,
                 nominal, spread, np.repeat(nominal[None], len(names), axis=0),
                 np.repeat(spread[None], len(names), axis=0), spread)  # fmt: skip


def _improve(mount: Mount) -> tuple[Mount, Array]:
    """One iteration of EM: the mount, and the sums of its vehicles and of its batches."""
    pooled, vehicles = mount.pooled, mount.weigh()
    measured = some, T, noise = mount.measured_batches(vehicles.information)
    spreads = both_cases(mount.spread, pooled.batch, pooled.batch_moved)
    y = twists_between(T, mount.nominal)
    batches = weigh(y, noise, spreads, pooled.share_batches)
    share = np.repeat([[1.0 - pooled.share_batches], [pooled.share_batches]],
                      len(mount.batches), axis=1)  # fmt: skip
    share[:, some] = batches.share
    precision = np.einsum("kb,kij->bij", share, np.linalg.inv(spreads))
    moved = solve_centers(mount, measured, np.linalg.inv(precision))
    own = vehicles.second_moments(moved.deviations(), moved.batch_covariance[mount.batch])
    y = twists_between(T, moved.nominal)
    of_batches = batches.second_moments(y, moved.nominal_covariance[None])
    sums = [_sums(vehicles, own, mount.spread), _sums(batches, of_batches, mount.spread)]
    return replace(moved, spread=_spread(vehicles.share[0], own[0])), np.array(sums)


def solve_centers(mount: Mount, measured: Batches, spread: Array) -> Mount:
    """The nominal pose and the batches, which scatter about it with (b, 6, 6) spreads."""
    some, T, noise = measured
    y = twists_between(T, mount.nominal)
    total: Array = np.asarray(np.linalg.inv(spread[some] + noise), np.float64)
    center, of_center = weighted_mean(y, total)
    gain = np.zeros_like(spread)
    gain[some] = spread[some] @ total
    rest = np.eye(6) - gain
    steps = np.tile(center, (len(spread), 1))
    steps[some] += np.einsum("bij,bj->bi", gain[some], y - center)
    starts = np.tile(mount.nominal, (len(spread) + 1, 1, 1))
    poses = retract_all(starts, -np.vstack([center, steps]))
    bars = rest @ spread + rest @ of_center @ rest.swapaxes(1, 2)
    return replace(mount, nominal=poses[0], nominal_covariance=of_center, T_batch=poses[1:],
                   batch_covariance=(bars + bars.swapaxes(1, 2)) / 2)  # fmt: skip


def _spread(share: Array, moments: Array) -> Array:
    """(6, 6) covariance of the regular deviations."""
    spread = np.einsum("n,nij->ij", share, moments) / share.sum()
    weight = _PSEUDO_VEHICLES / (_PSEUDO_VEHICLES + share.sum())
    spread = (1 - weight) * spread + weight * np.diag(np.diag(spread))
    return np.asarray((spread + spread.T) / 2)


def _sums(posterior: Posterior, moments: Array, spread: Array) -> Array:
    """(2, 2): of each case the expected number; their sums of squares over the spread."""
    squares = np.einsum("kij,knji->kn", np.linalg.inv(both_cases(spread, 1.0, 1.0)), moments)
    return np.array([posterior.share.sum(axis=1), (posterior.share * squares).sum(axis=1)])


def _pool(vehicles: Array, batches: Array) -> Pooled:
    """What the cameras of a model share, from the sums of all."""
    start = Pooled()
    batch, batch_moved = _variances(batches, [start.batch, start.batch_moved])
    return Pooled(
        moved=max(9.0, _variances(vehicles, [1.0, start.moved])[1]),
        batch=float(batch),
        batch_moved=max(9.0 * float(batch), float(batch_moved)),
        share_moved=_share(vehicles, start.share_moved),
        share_batches=_share(batches, start.share_batches),
    )


def _variances(sums: Array, defaults: Sequence[float]) -> Array:
    """(2,) of both cases."""
    return np.asarray((6 * np.array(defaults) + sums[1]) / (6 * (1 + sums[0])))


def _share(sums: Array, default: float) -> float:
    """Of the second case."""
    return float((_PSEUDO_CAMERAS * default + sums[0, 1]) / (_PSEUDO_CAMERAS + sums[0].sum()))


Words = NDArray[np.str_]

NAMES = ("vehicle", "camera", "model", "batch")
_NO_COVARIATES = (*NAMES, "seconds", "probability_off", "date")
_NUMBERS = pa.types.is_floating, pa.types.is_integer
_UNKNOWN = 1e6
"""Variance [rad^2, m^2] of a camera without a usable result: it leaves the prior as it is."""


@dataclass(frozen=True, eq=False)
class Observations:
    """One row per vehicle and camera.

    Attributes:
        vehicle, camera, model, batch: (n,) names; model and batch are empty where not given.
        T_camera_lidar: (n, 4, 4).
        covariance: (n, 6, 6) of xi in T_camera_lidar = exp(xi) estimate (rotation [rad], then
            translation [m], in the camera's axes).
        measured: (n,) whether the row has a result with an error bar that did not FAIL.
        day: (n,) days since 1970; NaN where there is no date.
        covariates: per column of numbers of the manifest, (n,), NaN where there is none.
    """

    vehicle: Words
    camera: Words
    model: Words
    batch: Words
    T_camera_lidar: Array
    covariance: Array
    measured: NDArray[np.bool_]
    day: Array
    covariates: Mapping[str, Array]

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some rows: a mask or an index array."""
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        covariates = {name: values[rows] for name, values in own.pop("covariates").items()}
        return Observations(**{k: v[rows] for k, v in own.items()}, covariates=covariates)


def observe(rows: pa.Table) -> Observations:
    """The rows of a fleet as arrays; columns of numbers beyond its own become covariates.

    Raises:
        CalibrationError: if a column is missing, or some poses are alignments and some mounts.
    """
    missing = [name for name in ("vehicle", "camera", "status", "T_camera_lidar", "covariance")
               if name not in rows.column_names]  # fmt: skip
    if missing:
        raise CalibrationError(
            f"the fleet's table has no column {missing[0]!r}, found "
            f"{', '.join(rows.column_names)}; give the folder that calibgraph fleet wrote"
        )
    done, vehicle = words(rows, "status") == "done", words(rows, "vehicle")
    of, first = np.unique(words(rows, "of")[done] == "mount", return_index=True)
    if len(of) > 1:
        alignment, mount = vehicle[done][first].tolist()
        raise CalibrationError(
            f"vehicle {mount!r} has mounts and vehicle {alignment!r} has alignments, which are "
            "different quantities; calibrate all with the same `of` in their settings"
        )
    T, placed = _fixed_size(rows, "T_camera_lidar", 16)
    covariance, bounded = _fixed_size(rows, "covariance", 36)
    measured = done & (words(rows, "verdict") != "FAIL") & placed & bounded
    measured &= words(rows, "camera") != ""
    unknown = np.eye(6) * _UNKNOWN
    numbers = [field.name for field in rows.schema if field.name not in _NO_COVARIATES
               and any(is_kind(field.type) for is_kind in _NUMBERS)]  # fmt: skip
    return Observations(
        **{name: words(rows, name) for name in NAMES},
        T_camera_lidar=np.where(measured[:, None, None], T.reshape(-1, 4, 4), np.eye(4)),
        covariance=np.where(measured[:, None, None], covariance.reshape(-1, 6, 6), unknown),
        measured=measured,
        day=days(rows),
        covariates={
            name: rows.column(name).cast(pa.float64()).fill_null(np.nan).to_numpy()
            for name in numbers
        },
    )


def newest_rows(rows: pa.Table) -> pa.Table:
    """The newest row of each vehicle and camera; of one date, or of none, the last."""
    index = np.argsort(np.nan_to_num(days(rows), nan=-np.inf), kind="stable")
    names = np.char.add(np.char.add(words(rows, "vehicle"), "\n"), words(rows, "camera"))[index]
    last = len(index) - 1 - np.unique(names[::-1], return_index=True)[1]
    return rows.take(pa.array(index[np.sort(last)]))


def words(rows: pa.Table, name: str) -> Words:
    """(n,) a column as text; empty where it is null or missing."""
    if name not in rows.column_names:
        return np.full(len(rows), "", dtype=np.str_)
    column = rows.column(name).cast(pa.string()).fill_null("")
    return np.asarray(column.to_numpy(), dtype=np.str_)


def days(rows: pa.Table) -> Array:
    """(n,) the column ``date`` in days since 1970; NaN where there is none."""
    if "date" not in rows.column_names:
        return np.full(len(rows), np.nan)
    try:
        stamps = rows.column("date").cast(pa.timestamp("us"))
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        raise CalibrationError(
            f"the fleet's column 'date' holds what is no date ({error}); write 2026-03-01"
        ) from error
    stamp = stamps.to_numpy()
    microseconds = stamp.astype("datetime64[us]").astype(np.float64)
    return np.where(np.isnat(stamp), np.nan, microseconds / 86_400e6)


def _fixed_size(rows: pa.Table, name: str, size: int) -> tuple[Array, NDArray[np.bool_]]:
    """(n, size) values of a column of lists, zero where it is null; (n,) where it is not."""
    column = rows.column(name).combine_chunks()
    present = np.asarray(column.is_valid())
    values = np.zeros((len(rows), size))
    values[present] = np.asarray(column.flatten(), dtype=np.float64).reshape(-1, size)
    return values, present & np.isfinite(values).all(axis=1)
