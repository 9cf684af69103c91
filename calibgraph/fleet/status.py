"""PASS, WARN, FAIL or no result: where each camera of each vehicle stands."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.stats import chi2, false_discovery_control

from calibgraph.fleet.findings import moved_lidars
from calibgraph.fleet.model import FALSE_DISCOVERIES, FleetModel
from calibgraph.fleet.observations import Observations, observe, words
from calibgraph.model.geometry import twists_between

STATES = ("PASS", "WARN", "FAIL", "NO RESULT")
_PASS, _WARN, _FAIL, _NO_RESULT = range(4)


@dataclass(frozen=True, eq=False)
class FleetStatus:
    """One entry per row of the fleet.

    Attributes:
        state: (n,) index into STATES. FAIL: that verdict, or the camera was moved in its mount.
            WARN: that verdict, no error bar, or another pose than before.
        changed: (n,) whether the pose is another one than before.
        reasons: (n,) in words; empty if PASS.
    """

    state: NDArray[np.uint8]
    changed: NDArray[np.bool_]
    reasons: list[str]


def assess_status(rows: pa.Table, fleet: FleetModel, before: pa.Table | None = None) -> FleetStatus:
    """Where every row stands."""
    changed = np.zeros(len(rows), dtype=np.bool_)
    if before is not None and len(before):
        changed = changed_poses(fleet.observations, observe(before))
    status, verdict = words(rows, "status"), words(rows, "verdict")
    done, measured = status == "done", fleet.observations.measured
    state = np.full(len(rows), _NO_RESULT, dtype=np.uint8)
    state[done] = _WARN
    state[measured & (verdict != "WARN") & ~changed] = _PASS
    state[fleet.apart | (done & (verdict == "FAIL"))] = _FAIL
    turned = set(moved_lidars(fleet))
    lidar = np.isin(fleet.observations.vehicle, list(turned)) if turned else changed & False
    return FleetStatus(state, changed, _reasons(rows, fleet, changed, lidar))


def changed_poses(now: Observations, before: Observations) -> NDArray[np.bool_]:
    """(n,) which poses are other ones than before, by more than both error bars explain.

    Among all that are reported, one in a hundred is expected not to be (Benjamini and Hochberg).
    """
    names, old = (np.char.add(np.char.add(o.vehicle, "\n"), o.camera) for o in (now, before))
    some, was = np.flatnonzero(now.measured), np.flatnonzero(before.measured)
    _, i, j = np.intersect1d(names[some], old[was], return_indices=True)
    changed = np.zeros(len(now.vehicle), dtype=np.bool_)
    if not len(i):
        return changed
    one, two = some[i], was[j]
    xi = twists_between(now.T_camera_lidar[one], before.T_camera_lidar[two])
    squared = np.einsum(
        "ni,nij,nj->n", xi, np.linalg.inv(now.covariance[one] + before.covariance[two]), xi
    )
    changed[one] = false_discovery_control(chi2.sf(squared, 6)) <= FALSE_DISCOVERIES
    return changed


def _reasons(
    rows: pa.Table, fleet: FleetModel, changed: NDArray[np.bool_], lidar: NDArray[np.bool_]
) -> list[str]:
    """In words, the fleet's reasons first."""
    columns = [rows.column(name).to_pylist() if name in rows.column_names else [None] * len(rows)
               for name in ("reasons", "error")]  # fmt: skip
    no_bar = ~fleet.observations.measured & (words(rows, "status") == "done")
    no_bar &= words(rows, "verdict") != "FAIL"
    reasons = []
    for index, (given, error) in enumerate(zip(*columns, strict=True)):
        own = ["the LiDAR was moved, or the rig taken apart"] if lidar[index] else []
        own += ["the camera was moved in its mount"] if fleet.apart[index] and not own else []
        own += ["another pose than before"] if changed[index] else []
        own += ["no error bar"] if no_bar[index] else []
        reasons.append("; ".join([*own, *(given or ()), *([error] if error else ())]))
    return reasons
