"""What happened to a fleet: tests of mounts, batches, dates and drifts, many at once.

All tests of a fleet are one family: what is reported was chosen by Benjamini and Hochberg's rule,
so of many reports one in a hundred is expected to be wrong, however many tests there were.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import chi2, false_discovery_control, fisher_exact

from calibgraph.arrays import Array
from calibgraph.audit.fleet_model import FALSE_DISCOVERIES, FleetModel, ModelFit
from calibgraph.audit.judgement import find_lidar_motion
from calibgraph.audit.model import fit_slope
from calibgraph.audit.mounts import Mount, Pooled
from calibgraph.model.geometry import twists_between

Kind = Literal["mount", "batch", "date", "drift"]

_MIN_ON_A_SIDE = 3
"""Vehicles before and after a date: with fewer, single vehicles would decide."""


@dataclass(frozen=True, eq=False)
class Finding:
    """One test of one camera of a model.

    Attributes:
        kind: a mount that moves in many vehicles, a batch that was changed, a date from which a
            batch is another one, or a drift against a column.
        model, camera, batch: where; batch is empty for all.
        change: (6,) rotation [rad], translation [m], of a batch, at a date, or per unit of the
            column; NaN of a mount.
        sigma: (6,) of it.
        at: the date (YYYY-MM-DD), the column, or how many cameras were moved.
        reach: from the least to the largest value of the column.
    """

    kind: Kind
    model: str
    camera: str
    batch: str
    p_value: float
    change: Array
    sigma: Array
    at: str = ""
    reach: float = 1.0

    @property
    def text(self) -> str:
        """One sentence."""
        where = f"{self.model or 'fleet'} {self.camera}"
        batch = f"batch {self.batch}" if self.batch else "all vehicles"
        return {
            "mount": f"{where}: the mount moved in {self.at} vehicles, more than other cameras'",
            "batch": f"{where}: {batch} differs from the model by {_size(self.change)}",
            "date": f"{where}: {batch} changed on {self.at} by {_size(self.change)}",
            "drift": f"{where}: drifts with {self.at}, {_size(self.change * self.reach)} "
            f"over its range of {self.reach:,.0f}",
        }[self.kind]


def _size(change: Array) -> str:
    """Angle and distance."""
    degrees = math.degrees(float(np.linalg.norm(change[:3])))
    return f"{degrees:.2g} deg, {100 * float(np.linalg.norm(change[3:])):.2g} cm"


def find_changes(fleet: FleetModel) -> list[Finding]:
    """Everything that stands out among mounts, batches, dates and drifts, the surest first."""
    tests = [test for name, model in fleet.models.items() for test in _tests(fleet, name, model)]
    if not tests:
        return []
    adjusted = false_discovery_control([test.p_value for test in tests])
    found = [test for test, p in zip(tests, adjusted, strict=True) if p <= FALSE_DISCOVERIES]
    return sorted(found, key=lambda finding: finding.p_value)


def _tests(fleet: FleetModel, name: str, model: ModelFit) -> Iterator[Finding]:
    """Every test of one model."""
    yield from _moved_mounts(fleet, name, model)
    for mount in model.mounts.values():
        yield from _changed_batches(mount, model.pooled)
        information, y = mount.weigh(model.pooled).information, mount.deviations()
        for batch, label in enumerate(mount.batches):
            rows = mount.batch == batch
            found = _change_at_a_date(mount.seen.day[rows], information[rows], y[rows])
            if found is not None:
                yield Finding("date", mount.model, mount.camera, label, *found)
        columns = {**mount.seen.covariates, "date": mount.seen.day}
        for column, x in columns.items():
            slope = fit_slope(x, mount.batch, information, y)
            if slope is not None:
                reach = float(np.nanmax(x) - np.nanmin(x))
                yield Finding("drift", mount.model, mount.camera, "", _p_value(*slope), slope[0],
                              np.sqrt(np.diag(slope[1])), column, reach)  # fmt: skip


def _moved_mounts(fleet: FleetModel, name: str, model: ModelFit) -> Iterator[Finding]:
    """Fisher's exact test: of a camera against the model's others, more were moved."""
    of, nothing = fleet.observations, np.full(6, np.nan)
    rows = (of.model == name) & of.measured
    counts = np.array([[np.count_nonzero(fleet.apart & rows & (of.camera == camera)),
                        np.count_nonzero(rows & (of.camera == camera))]
                       for camera in model.mounts])  # fmt: skip
    if len(counts) == 1:
        return
    for camera, (moved, all_of_it) in zip(model.mounts, counts, strict=True):
        others = counts.sum(axis=0) - [moved, all_of_it]
        table = [[moved, all_of_it - moved], [others[0], others[1] - others[0]]]
        p = float(fisher_exact(table, alternative="greater").pvalue)
        yield Finding("mount", name, camera, "", p, nothing, nothing, f"{moved} of {all_of_it}")


def _changed_batches(mount: Mount, pooled: Pooled) -> Iterator[Finding]:
    """Batches whose centre is further from the model's than batches scatter."""
    if len(mount.batches) == 1:
        return
    some, T, noise = mount.measured_batches(mount.weigh(pooled))
    y = twists_between(T, mount.centers.nominal)
    total = noise + pooled.batch * mount.spread + mount.centers.nominal_covariance
    for batch, deviation, covariance in zip(some, y, total, strict=True):
        sigma = np.sqrt(np.diag(covariance))
        yield Finding("batch", mount.model, mount.camera, mount.batches[batch],
                      _p_value(deviation, covariance), deviation, sigma)  # fmt: skip


def _change_at_a_date(
    day: Array, information: Array, y: Array
) -> tuple[float, Array, Array, str] | None:
    """The split in time with the largest change; its p-value counts all splits (Bonferroni).

    Args:
        day: (n,) of one batch; NaN where unknown.
        information: (n, 6, 6) of each vehicle about the batch's centre.
        y: (n, 6) deviations.

    Returns:
        p-value, (6,) change, (6,) sigma, the first day after it. None with too few vehicles.
    """
    order = np.argsort(day)[: np.count_nonzero(np.isfinite(day))]
    if len(order) < 2 * _MIN_ON_A_SIDE:
        return None
    H = information[order].cumsum(axis=0)
    g = np.einsum("nij,nj->ni", information[order], y[order]).cumsum(axis=0)
    splits = np.arange(_MIN_ON_A_SIDE - 1, len(order) - _MIN_ON_A_SIDE)
    before, after = np.linalg.inv(H[splits]), np.linalg.inv(H[-1] - H[splits])
    change = np.einsum("kij,kj->ki", after, g[-1] - g[splits])
    change -= np.einsum("kij,kj->ki", before, g[splits])
    covariance = before + after
    squared = np.einsum("ki,kij,kj->k", change, np.linalg.inv(covariance), change)
    best = int(np.argmax(squared))
    first = np.datetime64(int(day[order][splits[best] + 1]), "D")
    p = min(1.0, len(splits) * float(chi2.sf(squared[best], 6)))
    return p, change[best], np.sqrt(np.diag(covariance[best])), str(first)


def _p_value(change: Array, covariance: Array) -> float:
    """Of a change of six axes, if there is none."""
    return float(chi2.sf(change @ np.linalg.solve(covariance, change), 6))


def moved_lidars(fleet: FleetModel) -> list[str]:
    """Vehicles whose LiDAR moved: all cameras deviate, as one motion of the LiDAR explains."""
    of = fleet.observations
    known = of.measured & np.isfinite(fleet.moved)
    apart, counts = (Counter(of.vehicle[rows].tolist()) for rows in (known & fleet.apart, known))
    return [name for name, count in apart.items() if count == counts[name] > 1
            and _explains(fleet, np.flatnonzero(known & (of.vehicle == name)))]  # fmt: skip


def _explains(fleet: FleetModel, rows: NDArray[np.intp]) -> bool:
    """Whether a motion of the LiDAR explains how the cameras of one vehicle deviate."""
    of, model = fleet.observations, fleet.models[str(fleet.observations.model[rows[0]])]
    spreads = [model.mounts[str(of.camera[row])].spread for row in rows]
    found = find_lidar_motion(
        fleet.deviation[rows].ravel(),
        block_diag(*(of.covariance[rows] + spreads)),
        [*of.T_camera_lidar[rows]],
        moved=range(len(rows)),
        quantile=0.0,
    )
    return found is not None
