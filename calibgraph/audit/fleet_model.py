"""What a fleet knows: the nominal pose of every camera, and every vehicle's deviation from it.

Vehicles of a model scatter about its nominal pose. The spread is learnt by EM (REML), and so is how
many cameras were moved and how far.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.linalg import block_diag

from calibgraph.arrays import Array
from calibgraph.audit.judgement import find_lidar_motion
from calibgraph.audit.model import Posterior, weigh, weighted_mean
from calibgraph.errors import CalibrationError
from calibgraph.model.geometry import retract_all, twists_between

FALSE_DISCOVERIES = 0.01
"""Expected share of wrong ones among everything that is flagged."""

_MIN_VEHICLES = 8
"""Measured vehicles from which a camera's spread is learnt: six axes need more than six."""

_PSEUDO_VEHICLES = 4.0
"""Added with the spread along each axis alone: correlations of few vehicles are not believed."""

_MOVED, _SHARE_MOVED, _PSEUDO_CAMERAS = 100.0, 0.02, 50.0
"""Defaults that a model starts from and is pulled towards, and the weight of that of the share; the
variance has the weight of one camera."""

_MAX_ITERATIONS, _TOLERANCE = 300, 1e-3  # relative change of the spread; its own error is over 1 %


@dataclass(frozen=True, eq=False)
class Mount:
    """One camera in all vehicles of a model.

    Attributes:
        model, camera: names.
        seen: the vehicles' observations.
        nominal: (4, 4) T_camera_lidar of the model.
        nominal_covariance: (6, 6) of xi in T_camera_lidar = exp(xi) nominal.
        spread: (6, 6) covariance of a vehicle's deviation.
        moved: variance of moved cameras, at least that of three standard deviations: a multiple of
            the spread, along any axis; of all cameras of the model.
        share_moved: of all cameras of the model.
    """

    model: str
    camera: str
    seen: Observations
    nominal: Array
    nominal_covariance: Array
    spread: Array
    moved: float = _MOVED
    share_moved: float = _SHARE_MOVED

    def deviations(self) -> Array:
        """(n, 6) measured, from the nominal pose; zero where nothing is."""
        y = twists_between(self.seen.T_camera_lidar, self.nominal)
        return np.where(self.seen.measured[:, None], y, 0.0)

    def weigh(self) -> Posterior:
        """The vehicles' deviations, given their measurements."""
        spreads = np.array([self.spread, self.moved * np.diag(np.diag(self.spread))])
        return weigh(self.deviations(), self.seen.covariance, spreads, self.share_moved)

    def covariance_of_a_vehicle(self) -> Array:
        """(6, 6) of xi in T_camera_lidar = exp(xi) nominal, of a further one that is not moved."""
        return self.spread + self.nominal_covariance


@dataclass(frozen=True, eq=False)
class FleetModel:
    """All models of a fleet, and its vehicles as they follow from them.

    Attributes:
        observations: the rows.
        mounts: per model and camera that enough vehicles measured.
        T_camera_lidar: (n, 4, 4) shrunk estimate of each row; as measured where its mount is
            unknown.
        covariance: (n, 6, 6) of it.
        deviation: (n, 6) measured deviation from the nominal pose; NaN if unknown.
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
    """The model of a fleet, and its vehicles' cameras shrunk towards it.

    A measurement with a small error bar stays as it is; one with a large one moves to the nominal
    pose.
    """
    models = {str(name): fit_mounts(observations.select(observations.model == name))
              for name in np.unique(observations.model)}  # fmt: skip
    T, covariance = observations.T_camera_lidar.copy(), observations.covariance.copy()
    deviation, moved = np.full((len(T), 6), np.nan), np.full(len(T), np.nan)
    for mount in (mount for mounts in models.values() for mount in mounts.values()):
        rows = np.flatnonzero(
            (observations.model == mount.model) & (observations.camera == mount.camera)
        )
        every = replace(mount, seen=observations.select(rows))
        posterior, deviation[rows] = every.weigh(), every.deviations()
        moved[rows] = posterior.share[1]
        mean, covariance[rows] = posterior.deviations(
            deviation[rows], mount.nominal_covariance[None]
        )
        T[rows] = retract_all(np.tile(mount.nominal, (len(rows), 1, 1)), -mean)
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
        count, squares = np.sum([sums for _, sums in steps], axis=0)
        moved = max(9.0, (6 * _MOVED + squares[1]) / (6 * (1 + count[1])))
        share = (_PSEUDO_CAMERAS * _SHARE_MOVED + count[1]) / (_PSEUDO_CAMERAS + count.sum())
        mounts = [replace(mount, moved=moved, share_moved=float(share)) for mount, _ in steps]
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
    return Mount(str(seen.model[0]), str(seen.camera[0]), seen, nominal, spread, spread)


def _improve(mount: Mount) -> tuple[Mount, Array]:
    """One iteration of EM: the mount, and (2, 2) of each case the expected number, and its squares.

    The squares are those of the deviations over the spread.
    """
    vehicles = mount.weigh()
    center, bar = weighted_mean(mount.deviations(), vehicles.information)
    nominal = retract_all(mount.nominal[None], -center[None])[0]
    moved = replace(mount, nominal=nominal, nominal_covariance=bar)
    moments, share = vehicles.second_moments(moved.deviations(), bar[None]), vehicles.share
    over = np.linalg.inv(np.array([mount.spread, np.diag(np.diag(mount.spread))]))
    squares = np.einsum("kij,knji->kn", over, moments)
    spread = np.einsum("n,nij->ij", share[0], moments[0]) / share[0].sum()
    weight = _PSEUDO_VEHICLES / (_PSEUDO_VEHICLES + share[0].sum())
    spread = (1 - weight) * spread + weight * np.diag(np.diag(spread))
    sums = np.array([share.sum(axis=1), (share * squares).sum(axis=1)])
    return replace(moved, spread=(spread + spread.T) / 2), sums


def moved_lidars(fleet: FleetModel) -> list[str]:
    """Vehicles whose LiDAR moved: all cameras deviate, as one motion of the LiDAR explains."""
    of = fleet.observations
    known = of.measured & np.isfinite(fleet.moved)
    apart, counts = (Counter(of.vehicle[rows].tolist()) for rows in (known & fleet.apart, known))
    return [name for name, count in apart.items() if count == counts[name] > 1
            and _explains(fleet, np.flatnonzero(known & (of.vehicle == name)))]  # fmt: skip


def _explains(fleet: FleetModel, rows: NDArray[np.intp]) -> bool:
    """Whether a motion of the LiDAR explains how the cameras of one vehicle deviate."""
    of, mounts = fleet.observations, fleet.mounts[str(fleet.observations.model[rows[0]])]
    spreads = [mounts[str(of.camera[row])].spread for row in rows]
    deviation, covariance = fleet.deviation[rows].ravel(), of.covariance[rows] + spreads
    poses, every = [*of.T_camera_lidar[rows]], range(len(rows))
    found = find_lidar_motion(deviation, block_diag(*covariance), poses, moved=every, quantile=0.0)
    return found is not None


Words = NDArray[np.str_]

NAMES = ("vehicle", "camera", "model")
_UNKNOWN = 1e6
"""Variance [rad^2, m^2] of a camera without a usable result: it leaves the prior as it is."""


@dataclass(frozen=True, eq=False)
class Observations:
    """One row per vehicle and camera.

    Attributes:
        vehicle, camera, model: (n,) names; the model is empty where not given.
        T_camera_lidar: (n, 4, 4).
        covariance: (n, 6, 6) of xi in T_camera_lidar = exp(xi) estimate (rotation [rad], then
            translation [m], in the camera's axes).
        measured: (n,) whether the row has a result with an error bar that did not FAIL.
        day: (n,) days since 1970; NaN where there is no date.
    """

    vehicle: Words
    camera: Words
    model: Words
    T_camera_lidar: Array
    covariance: Array
    measured: NDArray[np.bool_]
    day: Array

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some rows: a mask or an index array."""
        return Observations(**{of.name: getattr(self, of.name)[rows] for of in fields(self)})


def observe(rows: pa.Table) -> Observations:
    """The rows of a fleet as arrays.

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
    return Observations(
        **{name: words(rows, name) for name in NAMES},
        T_camera_lidar=np.where(measured[:, None, None], T.reshape(-1, 4, 4), np.eye(4)),
        covariance=np.where(measured[:, None, None], covariance.reshape(-1, 6, 6), unknown),
        measured=measured,
        day=days(rows),
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
