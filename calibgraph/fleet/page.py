"""What a fleet's rows show: the model's files, and one page with the state of each camera."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.audit.findings import Finding, find_changes, moved_lidars
from calibgraph.audit.fleet_model import FleetModel, expected_pose, fit_fleet
from calibgraph.audit.mounts import Mount, Pooled
from calibgraph.audit.observations import NAMES, newest_rows, observe, words
from calibgraph.fleet.rows import RowStore, encode, read_rows
from calibgraph.report.kit import load_template

PAGE_FILE, MODEL_FILE, ESTIMATES_FILE = "fleet.html", "fleet_model.json", "estimates.parquet"
FORMAT = "calibgraph-fleet-model/2"
STATES = ("PASS", "WARN", "FAIL", "NO RESULT")
_PASS, _WARN, _FAIL, _NO_RESULT = range(4)
_UNITS = np.repeat([np.radians(1e-3), 1e-4], 3)  # thousandths of a degree, tenths of a millimetre
_LONGEST_REASON = 200  # characters


@dataclass(frozen=True, eq=False)
class FleetReport:
    """The model of a fleet, and everything that stands out, the surest first."""

    fleet: FleetModel
    findings: Sequence[Finding]
    moved_lidars: Sequence[str]


def write_fleet_report(out: str) -> FleetReport:
    """Fit the model of the rows in a folder, and write its files and its page beside them.

    Of several rows of a vehicle and camera the newest counts.

    Args:
        out: folder or URI of :func:`calibgraph.run_fleet`.

    Raises:
        CalibrationError: if no rows are there, or nothing can be written.
    """
    newest, store = newest_rows(read_rows(out)), RowStore(out)
    fleet = fit_fleet(observe(newest))
    report = FleetReport(fleet, find_changes(fleet), moved_lidars(fleet))
    status = assess_status(newest, report)
    store.put(ESTIMATES_FILE, encode(estimates(fleet)))
    store.put(MODEL_FILE, json.dumps(summary(report), indent=1).encode())
    store.put(PAGE_FILE, page_html(report, status).encode())
    return report


@dataclass(frozen=True, eq=False)
class FleetStatus:
    """One entry per row of the fleet.

    Attributes:
        state: (n,) index into STATES. FAIL: that verdict, or the camera was moved in its mount.
            WARN: that verdict, or no error bar.
        reasons: (n,) in words; empty if PASS.
    """

    state: NDArray[np.uint8]
    reasons: list[str]


def assess_status(rows: pa.Table, report: FleetReport) -> FleetStatus:
    """Where every row stands."""
    fleet, done = report.fleet, words(rows, "status") == "done"
    verdict, measured = words(rows, "verdict"), fleet.observations.measured
    state = np.full(len(rows), _NO_RESULT, dtype=np.uint8)
    state[done] = _WARN
    state[measured & (verdict != "WARN")] = _PASS
    state[fleet.apart | (done & (verdict == "FAIL"))] = _FAIL
    lidar = np.isin(fleet.observations.vehicle, np.array(report.moved_lidars, dtype=np.str_))
    own = {
        "the LiDAR was moved, or the rig taken apart": lidar,
        "the camera was moved in its mount": fleet.apart & ~lidar,
        "no error bar": ~measured & done & (verdict != "FAIL"),
    }
    given = [rows.column(name).to_pylist() if name in rows.column_names else [None] * len(rows)
             for name in ("reasons", "error")]  # fmt: skip
    reasons = []
    for k, (why, error) in enumerate(zip(*given, strict=True)):
        of_row = [text for text, of in own.items() if of[k]]
        reasons.append("; ".join([*of_row, *(why or ()), *([error] if error else ())]))
    return FleetStatus(state, reasons)


def estimates(fleet: FleetModel) -> pa.Table:
    """A row per vehicle and camera: its estimate with what the fleet knows."""
    of = fleet.observations
    lists = {
        "T_camera_lidar": fleet.T_camera_lidar,
        "covariance": fleet.covariance,
        "deviation": np.where(of.measured[:, None], fleet.deviation, np.nan),
    }
    return pa.table({
        **{name: getattr(of, name) for name in NAMES},
        **{name: pa.FixedSizeListArray.from_arrays(pa.array(np.ravel(each)), each[0].size)
           for name, each in lists.items()},
        "moved_probability": fleet.moved,
        "stands_apart": fleet.apart,
        "measured": of.measured,
    })  # fmt: skip


def summary(report: FleetReport) -> dict[str, Any]:
    """What is known of every model, and what happened, in plain numbers."""
    return {
        "format": FORMAT,
        "models": {
            name: {
                "cameras": {camera: _mount(m, model.pooled) for camera, m in model.mounts.items()},
                "moved_share": model.pooled.share_moved,
            }
            for name, model in report.fleet.models.items()
        },
        "findings": [
            {"kind": each.kind, "text": each.text, "p_value": each.p_value,
             "change": None if each.kind == "mount" else each.change.tolist(),
             "sigma": None if each.kind == "mount" else each.sigma.tolist()}
            for each in report.findings
        ],
        "moved_lidars": [*report.moved_lidars],
    }  # fmt: skip


def _mount(mount: Mount, pooled: Pooled) -> dict[str, Any]:
    """Nominal pose, and the covariances of a further vehicle, and of vehicles within a batch."""
    T, covariance = expected_pose(mount, pooled)
    batches = dict(zip(mount.batches, mount.centers.batches.tolist(), strict=True))
    return {"vehicles": len(mount.seen.vehicle), "T": T.tolist(),
            "covariance_of_a_vehicle": covariance.tolist(),
            "spread_within_a_batch": mount.spread.tolist(), "batches": batches}  # fmt: skip


def page_html(report: FleetReport, status: FleetStatus) -> str:
    """One HTML page that needs nothing else: no network, no files beside it."""
    known = report.fleet.observations.day
    known = known[np.isfinite(known)]
    newest = str(np.datetime64(int(known.max()), "D")) if len(known) else ""
    content = payload(report, status)
    template = load_template("page.html.j2", "calibgraph.fleet")
    return template.render(content=content, vehicles=len(content["vehicles"]), newest=newest)


def payload(report: FleetReport, status: FleetStatus) -> dict[str, Any]:
    """What the page's script reads: names once, numbers as integers."""
    of = report.fleet.observations
    order = np.lexsort([of.camera, of.vehicle])
    vehicles, first, vehicle = np.unique(of.vehicle[order], return_index=True, return_inverse=True)
    named = {"model": of.model[order][first], "batch": of.batch[order][first],
             "camera": of.camera[order],
             "reason": [status.reasons[k][:_LONGEST_REASON] for k in order]}  # fmt: skip
    names, index = {}, {}
    for name, values in named.items():
        found, numbers = np.unique(np.array(values, dtype=np.str_), return_inverse=True)
        names[name], index[name] = found.tolist(), numbers.tolist()
    sigma = np.sqrt(np.diagonal(of.covariance, axis1=1, axis2=2))
    return {
        "states": STATES, "vehicles": vehicles.tolist(), "cameras": names["camera"],
        "models": names["model"], "batches": names["batch"], "reasons": names["reason"],
        "findings": [[finding.kind, finding.text] for finding in report.findings],
        **index, "vehicle": vehicle.tolist(),
        "day": np.nan_to_num(of.day[order][first], nan=-1).astype(int).tolist(),
        "state": status.state[order].tolist(),
        **{name: _integers(np.where(of.measured[:, None], values, np.nan)[order])
           for name, values in (("deviation", report.fleet.deviation), ("sigma", sigma))},
    }  # fmt: skip


def _integers(twists: Array) -> list[int | None]:
    """(6 n,) of twists, None where they are unknown."""
    scaled = (twists / _UNITS).ravel().tolist()
    return [None if np.isnan(value) else round(value) for value in scaled]
