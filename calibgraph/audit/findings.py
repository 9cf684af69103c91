"""What happened to a fleet: tests of mounts, batches, dates and drifts, many at once.

All tests of a fleet are one family: what is reported was chosen by Benjamini and Hochberg's rule,
so of many reports one in a hundred is expected to be wrong, however many tests there were.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.stats import chi2, false_discovery_control, fisher_exact

from calibgraph.arrays import Array
from calibgraph.audit.fleet_model import FALSE_DISCOVERIES, FleetModel, Mount
from calibgraph.audit.judgement import find_lidar_motion
from calibgraph.audit.model import fit_slope
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
            "batch": f"{where}: {batch} differs from the model by {describe_size(self.change)}",
            "date": f"{where}: {batch} changed on {self.at} by {describe_size(self.change)}",
            "drift": f"{where}: drifts with {self.at}, {describe_size(self.change * self.reach)} "
            f"over its range of {self.reach:,.0f}",
        }[self.kind]


def describe_size(change: Array) -> str:
    """Angle and distance."""
    degrees = math.degrees(float(np.linalg.norm(change[:3])))
    return f"{degrees:.2g} deg, {100 * float(np.linalg.norm(change[3:])):.2g} cm"


def find_changes(fleet: FleetModel) -> list[Finding]:
    """Everything that stands out among mounts, batches, dates and drifts, the surest first."""
    tests: list[Finding] = []
    for mounts in fleet.mounts.values():
        tests += _moved_mounts(fleet, mounts)
        for mount in mounts.values():
            tests += [*_changed_batches(mount), *_changes_at_dates(mount), *_drifts(mount)]
    if not tests:
        return []
    adjusted = false_discovery_control([test.p_value for test in tests])
    found = [test for test, p in zip(tests, adjusted, strict=True) if p <= FALSE_DISCOVERIES]
    return sorted(found, key=lambda finding: finding.p_value)


def _moved_mounts(fleet: FleetModel, mounts: Mapping[str, Mount]) -> Iterator[Finding]:
    """Fisher's exact test: of a camera against its model's others, more were moved."""
    of, nothing = fleet.observations, np.full(6, np.nan)
    rows = [of.measured & (of.model == mount.model) & (of.camera == mount.camera)
            for mount in mounts.values()]  # fmt: skip
    counts = np.array([[np.count_nonzero(some & fleet.apart), some.sum()] for some in rows])
    for mount, own in zip(mounts.values() if len(counts) > 1 else (), counts, strict=False):
        sides = np.array([own, counts.sum(axis=0) - own])
        table = np.column_stack([sides[:, 0], sides[:, 1] - sides[:, 0]])
        p = float(fisher_exact(table, alternative="greater").pvalue)
        at = f"{own[0]} of {own[1]}"
        yield Finding("mount", mount.model, mount.camera, "", p, nothing, nothing, at)


def _changed_batches(mount: Mount) -> Iterator[Finding]:
    """Batches whose centre is further from the model's than batches scatter."""
    if len(mount.batches) == 1:
        return
    some, T, noise = mount.measured_batches(mount.weigh().information)
    y = twists_between(T, mount.nominal)
    total = noise + mount.pooled.batch * mount.spread + mount.nominal_covariance
    for batch, deviation, covariance in zip(some, y, total, strict=True):
        yield Finding("batch", mount.model, mount.camera, mount.batches[batch],
                      _p_value(deviation, covariance), deviation, _sigma(covariance))  # fmt: skip


def _drifts(mount: Mount) -> Iterator[Finding]:
    """Slopes over the date and over each column of numbers."""
    information, y = mount.weigh().information, mount.deviations()
    for column, x in {**mount.seen.covariates, "date": mount.seen.day}.items():
        slope = fit_slope(x, mount.batch, information, y)
        if slope is not None:
            reach = float(np.nanmax(x) - np.nanmin(x))
            yield Finding("drift", mount.model, mount.camera, "", _p_value(*slope), slope[0],
                          _sigma(slope[1]), column, reach)  # fmt: skip


def _changes_at_dates(mount: Mount) -> Iterator[Finding]:
    """Per batch, the split in time with the largest change; p counts all splits (Bonferroni)."""
    information, y, day = mount.weigh().information, mount.deviations(), mount.seen.day
    for batch, label in enumerate(mount.batches):
        rows = np.flatnonzero((mount.batch == batch) & np.isfinite(day))
        rows = rows[np.argsort(day[rows])]
        splits = np.arange(_MIN_ON_A_SIDE - 1, len(rows) - _MIN_ON_A_SIDE)
        if not len(splits):
            continue
        H = information[rows].cumsum(axis=0)
        g = np.einsum("nij,nj->ni", information[rows], y[rows]).cumsum(axis=0)
        before, after = np.linalg.inv(H[splits]), np.linalg.inv(H[-1] - H[splits])
        change = np.einsum("kij,kj->ki", after, g[-1] - g[splits])
        change -= np.einsum("kij,kj->ki", before, g[splits])
        covariance = before + after
        squared = np.einsum("ki,kij,kj->k", change, np.linalg.inv(covariance), change)
        best = int(np.argmax(squared))
        first = np.datetime64(int(day[rows][splits[best] + 1]), "D")
        p = min(1.0, len(splits) * float(chi2.sf(squared[best], 6)))
        yield Finding("date", mount.model, mount.camera, label, p, change[best],
                      _sigma(covariance[best]), str(first))  # fmt: skip


def _p_value(change: Array, covariance: Array) -> float:
    """Of a change of six axes, if there is none."""
    return float(chi2.sf(change @ np.linalg.solve(covariance, change), 6))


def _sigma(covariance: Array) -> Array:
    return np.asarray(np.sqrt(np.diag(covariance)))


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
