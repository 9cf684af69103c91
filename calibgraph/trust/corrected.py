"""Clouds that are corrected for motion already, although their points have times.

A LiDAR that turns fires at azimuths by its time alone, whatever is there. In a corrected cloud the
azimuth of a point at time t and range r has changed by (v t) . e / r, with e across the ray: more
of near points than of far ones. So of the cloud as it is and of the same moved back, one has the
azimuths of its times. That needs neither a static world nor a second scan. LiDARs that do not turn
show neither, nor do clouds whose times are by packet.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.io.dataset import Dataset, spread_out
from calibgraph.matching.run import MatchingRun
from calibgraph.model.verdict import Check
from calibgraph.trust.evidence import Found
from factors import displace

TWICE = "clouds corrected for motion twice"
"""Name of the check."""
LOOKED_AT = 6  # clouds of each LiDAR
_LEAST, _CLEARLY = 2, 4  # that are corrected; times as many as the others
_SLOW_M_S, _SHORT_S = 2.0, 0.003
_NEAR_M, _FAR_M, _WAYS = 3.0, 80.0, 5.0  # ranges; the least also over the way of a scan
_FEWEST, _MOST = 1000, 20_000  # points
_BINS, _BEAM = 400, np.radians(0.25)  # of time, of elevation
_SPREAD = np.radians(0.2)  # of azimuths as fired: 0.01 to 0.03 deg of four kinds of LiDARs
_NEARER = 1.15  # ratio of the spreads
_MOVED = 0.3  # share of the motion that azimuths as fired may show


def corrected_checks(run: MatchingRun) -> Found:
    """Whether the clouds that cameras are matched with were corrected before."""
    if text := corrected_clouds(run.dataset):
        yield from ((name, Check(TWICE, "WARN", text)) for name in run.guess.cameras)


def corrected_clouds(data: Dataset) -> str:
    """A line if the clouds that a dataset corrects were corrected before; kept by its frames."""
    frames = spread_out([frame for frame in data.frames if frame.find_motion], LOOKED_AT)

    def find() -> str:
        swept = ((replace(frame, joined={}).load_sweep(), frame.twist_per_s) for frame in frames)
        return corrected_twice(((sweep, v) for sweep, v in swept if sweep), data.rig.lidar)

    return frames[0].derive_for_all(TWICE, find) if frames else ""


def corrected_twice(
    sweeps: Iterable[tuple[tuple[Array, Array | None], Array | None]], lidar: str
) -> str:
    """A line if points are corrected for this motion already; empty if they are not.

    Args:
        sweeps: (n, 3) points of a LiDAR in its frame with (n,) times [s], and its (6,) twist.
        lidar: its name.
    """
    found, way_m = list[bool | None](), 0.0
    for (points, times_s), twist in sweeps:
        if times_s is None or twist is None or np.ptp(times_s) < _SHORT_S:
            continue
        if np.hypot(*twist[3:5]) > _SLOW_M_S:
            found.append(_has_moved(points, times_s, twist))
            way_m = max(way_m, float(np.ptp(times_s) * np.hypot(*twist[3:5])))
    moved = found.count(True)
    if moved < _LEAST or moved <= _CLEARLY * found.count(False):
        return ""
    return (
        f"{lidar}: {moved} of {len(found)} clouds were corrected for motion before: the LiDAR did "
        "not fire where their points are at these times. A second correction errs by up to "
        f"{100 * way_m:.0f} cm: state instant_clouds: true in --config"
    )


def _has_moved(points_m: Array, times_s: Array, twist_per_s: Array) -> bool | None:
    """Whether points have moved by the motion already; None where they do not tell."""
    ranges = np.hypot(points_m[:, 0], points_m[:, 1])
    least_m = max(_WAYS * float(np.ptp(times_s) * np.hypot(*twist_per_s[3:5])), _NEAR_M)
    rows = np.flatnonzero((ranges > least_m) & (ranges < _FAR_M))
    if len(rows) < _FEWEST:
        return None
    rows = np.random.default_rng(0).permutation(rows)[:_MOST]
    points, seconds = points_m[rows], times_s[rows] - times_s.mean()
    spread, fits = _as_fired(points, seconds, twist_per_s)
    before = displace(points, twist_per_s, -seconds)
    spread_before, fits_before = _as_fired(before, seconds, twist_per_s)
    if fits_before and spread > _NEARER * spread_before:
        return True
    return False if fits and spread_before > _NEARER * spread else None


def _as_fired(points_m: Array, times_s: Array, twist_per_s: Array) -> tuple[float, bool]:
    """The spread [rad] of azimuths about what time and beam predict, and if a LiDAR fires so."""
    (x, y, z), r, (vx, vy) = points_m.T, np.hypot(*points_m[:, :2].T), twist_per_s[3:5]
    at_time = ((times_s - times_s.min()) * (_BINS / np.ptp(times_s))).astype(np.int64)
    beams = np.unique(np.floor(np.arctan2(z, r) / _BEAM), return_inverse=True)[1]

    def rest(values: Array) -> Array:
        for groups in (at_time, beams) * 3:
            means = np.bincount(groups, values) / np.maximum(np.bincount(groups), 1)
            values = values - means[groups]
        return values

    ahead = np.bincount(at_time, x / r) + 1j * np.bincount(at_time, y / r)
    azimuth = rest(np.angle((x + 1j * y) * ahead[at_time].conj()))
    along, across = (x * vy - y * vx) / r**2, (x * vx + y * vy) / r**2
    # the motion, and one across it; another origin; the turn within a bin
    columns = along * times_s, across * times_s, x / r**2, y / r**2, times_s
    A = np.column_stack([rest(column) for column in columns])
    left = azimuth - A[:, 2:] @ np.linalg.lstsq(A[:, 2:], azimuth)[0]
    spread, shares = float(np.median(np.abs(left))), np.linalg.lstsq(A, azimuth)[0][:2]
    return spread, bool(spread < _SPREAD and (np.abs(shares) < _MOVED).all())
