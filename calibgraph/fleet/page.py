"""The fleet on one page: the state of each camera, compact arrays, a table of what is in view."""

import base64
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.stats import chi2, false_discovery_control

from calibgraph.arrays import Array
from calibgraph.files import write_text
from calibgraph.fleet.findings import find_changes, moved_lidars
from calibgraph.fleet.model import FALSE_DISCOVERIES, FleetModel, fit_fleet
from calibgraph.fleet.observations import (
    Observations,
    Words,
    newest_rows,
    observe,
    require_one_quantity,
    words,
)
from calibgraph.model.geometry import twists_between
from calibgraph.report.kit import load_template

_MILLIDEGREE, _TENTH_OF_MM = np.radians(1e-3), 1e-4
_NOTHING = -32768  # in place of a deviation
_WEEK = 7.0
_LONGEST_REASON, _MOST_REASONS = 200, 4000  # characters; different ones, 0.8 MB in all


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
        require_one_quantity(rows, before)
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


def write_fleet_report(
    rows: pa.Table, path: Path, *, before: pa.Table | None = None, link: str = ""
) -> FleetModel:
    """Write a fleet as one HTML page that needs nothing else: no network, no files beside it.

    Args:
        rows: as of ``read_rows``; of several of a vehicle and camera the newest counts.
        path: of the page.
        before: an earlier table to compare with; the rows of a week and more before the newest
            if None.
        link: of a vehicle's own report, with ``{vehicle}`` for its name.

    Returns:
        The model of the fleet that the page shows.

    Raises:
        CalibrationError: if the table is not a fleet's.
        FileError: if the page cannot be written.
    """
    newest = newest_rows(rows)
    fleet = fit_fleet(observe(newest))
    earlier = newest_rows(rows, days_ago=_WEEK) if before is None else newest_rows(before)
    status = assess_status(newest, fleet, earlier)
    template = load_template("page.html.j2", "calibgraph.fleet")
    content, last = payload(fleet, status, link), _last_day(fleet.observations.day)
    write_text(
        path, template.render(content=content, vehicles=len(content["vehicles"]), newest=last)
    )
    return fleet


def _last_day(days: Array) -> str:
    """The newest date, YYYY-MM-DD; empty without any."""
    known = days[np.isfinite(days)]
    return str(np.datetime64(int(known.max()), "D")) if len(known) else ""


def payload(fleet: FleetModel, status: FleetStatus, link: str) -> dict[str, Any]:
    """What the page's script reads: names once, numbers as little-endian arrays in base64."""
    of = fleet.observations
    order = np.lexsort([of.camera, of.vehicle])
    vehicles, first, vehicle = np.unique(of.vehicle[order], return_index=True, return_inverse=True)
    first = order[first]
    cameras, camera = np.unique(of.camera[order], return_inverse=True)
    models, model = _names(of.model[first])
    batches, batch = _names(of.batch[first])
    reasons, reason = _count_reasons([status.reasons[index] for index in order])
    sigma = np.sqrt(np.diagonal(of.covariance, axis1=1, axis2=2))
    return {
        "states": STATES, "link": link, "cameras": cameras.tolist(), "models": models,
        "batches": batches, "vehicles": vehicles.tolist(), "reasons": reasons,
        "findings": [[finding.kind, finding.text] for finding in find_changes(fleet)],
        "model": _pack(model, "<u2"), "batch": _pack(batch, "<u2"),
        "day": _pack(np.nan_to_num(of.day[first], nan=-1), "<i4"),
        "vehicle": _pack(vehicle, "<u4"), "camera": _pack(camera, "<u2"),
        "state": _pack(status.state[order], "<u1"),
        "changed": _pack(status.changed[order], "<u1"),
        "reason": _pack(reason, "<u2"),
        **{name: _pack(_scaled(np.where(of.measured[:, None], values, np.nan)[order]), "<i2")
           for name, values in (("deviation", fleet.deviation), ("sigma", sigma))},
    }  # fmt: skip


def _names(of_vehicles: Words) -> tuple[list[str], NDArray[np.intp]]:
    names, index = np.unique(of_vehicles, return_inverse=True)
    return names.tolist(), index


def _scaled(twists: Array) -> Array:
    """(n, 6) in thousandths of a degree and tenths of a millimetre, within 16 bits."""
    scaled = np.rint(twists / np.repeat([_MILLIDEGREE, _TENTH_OF_MM], 3)).clip(-32767, 32767)
    return np.where(np.isfinite(scaled), scaled, _NOTHING)


def _pack(values: NDArray[Any], kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()


def _count_reasons(reasons: list[str]) -> tuple[list[str], NDArray[np.intp]]:
    """The different reasons, the most frequent ones, and each row's; the others in short."""
    short = [text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."
             for text in reasons]  # fmt: skip
    known = [text for text, _ in Counter(short).most_common(_MOST_REASONS)]
    index = {text: number for number, text in enumerate(known)}
    other = len(known)
    return [*known, "see the vehicle's report"], np.array(
        [index.get(text, other) for text in short]
    )
