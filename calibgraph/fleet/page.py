"""What a fleet's rows show: the model's files, and one page with the state of each camera."""

import json
import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.audit.fleet_model import (
    NAMES,
    FleetModel,
    Mount,
    fit_fleet,
    moved_lidars,
    newest_rows,
    observe,
    words,
)
from calibgraph.audit.result import twist_cells
from calibgraph.fleet.files import Store, read_rows
from calibgraph.report.kit import page_template

STATES = ("PASS", "NO RESULT", "WARN", "FAIL")
"""The worst last."""
_PASS, _NO_RESULT, _WARN, _FAIL = range(4)
_LONGEST_REASON = 200  # characters


@dataclass(frozen=True, eq=False)
class FleetReport:
    """The model of a fleet, and where each row stands.

    Attributes:
        fleet: the model.
        moved_lidars: names of vehicles.
        state: (n,) index into STATES. FAIL: that verdict, or the camera was moved in its mount.
            WARN: that verdict, or no error bar.
        reasons: (n,) in words; empty if PASS.
    """

    fleet: FleetModel
    moved_lidars: Sequence[str]
    state: NDArray[np.uint8]
    reasons: Sequence[str]


def write_fleet_report(out: str) -> FleetReport:
    """Fit the model of the rows in a folder, and write its files and its page beside them.

    Of several rows of a vehicle and camera the newest counts.

    Raises:
        CalibrationError: if no rows are there, or nothing can be written.
    """
    report, store = report_of(newest_rows(read_rows(out))), Store(out)
    store.put("estimates.parquet", _estimates(report.fleet))
    store.put("fleet_model.json", json.dumps(_summary(report), indent=1).encode())
    store.put("fleet.html", _page(report).encode())
    return report


def report_of(rows: pa.Table) -> FleetReport:
    """What rows show, one of each vehicle and camera."""
    fleet = fit_fleet(observe(rows))
    lidars, measured = moved_lidars(fleet), fleet.observations.measured
    done, verdict = words(rows, "status") == "done", words(rows, "verdict")
    state = np.full(len(rows), _NO_RESULT, dtype=np.uint8)
    state[done] = _WARN
    state[measured & (verdict != "WARN")] = _PASS
    state[fleet.apart | (done & (verdict == "FAIL"))] = _FAIL
    of_lidar = np.isin(fleet.observations.vehicle, np.array(lidars, dtype=np.str_))
    own = {
        "the LiDAR was moved, or the rig taken apart": of_lidar,
        "the camera was moved in its mount by {}": fleet.apart & ~of_lidar,
        "no error bar": ~measured & done & (verdict != "FAIL"),
    }
    given = [rows.column(name).to_pylist() if name in rows.column_names else [None] * len(rows)
             for name in ("reasons", "error")]  # fmt: skip
    reasons = []
    for k, (why, error) in enumerate(zip(*given, strict=True)):
        size = _describe_size(fleet.deviation[k])
        of_row = [text.format(size) for text, of in own.items() if of[k]]
        reasons.append("; ".join([*of_row, *(why or ()), *([error] if error else ())]))
    return FleetReport(fleet, lidars, state, reasons)


def _describe_size(change: Array) -> str:
    """Angle and distance."""
    degrees = math.degrees(float(np.linalg.norm(change[:3])))
    return f"{degrees:.2g} deg, {100 * float(np.linalg.norm(change[3:])):.2g} cm"


def _estimates(fleet: FleetModel) -> pa.Table:
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


def _summary(report: FleetReport) -> dict[str, Any]:
    """What is known of every model, in plain numbers."""
    models = {
        name: {"cameras": {camera: _mount(mount) for camera, mount in mounts.items()},
               "moved_share": next(iter(mounts.values())).share_moved}
        for name, mounts in report.fleet.mounts.items()
    }  # fmt: skip
    return {"format": "calibgraph-fleet-model/3", "models": models,
            "moved_lidars": [*report.moved_lidars]}  # fmt: skip


def _mount(mount: Mount) -> dict[str, Any]:
    """Nominal pose, and the covariances of a further vehicle, and of vehicles about the pose."""
    return {"vehicles": len(mount.seen.vehicle), "T": mount.nominal.tolist(),
            "covariance_of_a_vehicle": mount.covariance_of_a_vehicle().tolist(),
            "spread": mount.spread.tolist()}  # fmt: skip


def _page(report: FleetReport) -> str:
    """One HTML page that needs nothing else: no network, no files beside it."""
    of, vehicles = report.fleet.observations, dict[str, dict[str, Any]]()
    dates = np.where(np.isfinite(of.day), of.day, 0).astype("datetime64[D]").astype(str)
    for k in np.lexsort([of.camera, of.vehicle]):
        date = dates[k] if np.isfinite(of.day[k]) else ""
        vehicle = vehicles.setdefault(str(of.vehicle[k]), {
            "model": str(of.model[k]), "date": date, "state": _PASS, "cameras": defaultdict(list)
        })  # fmt: skip
        vehicle["state"] = max(vehicle["state"], report.state[k])
        if report.state[k] != _PASS:  # the same of several cameras is one line
            alike = STATES[report.state[k]], report.reasons[k][:_LONGEST_REASON]
            vehicle["cameras"][alike].append(of.camera[k])
    counts = Counter(STATES[vehicle["state"]] for vehicle in vehicles.values())
    listed = [(name, each) for name, each in vehicles.items() if each["state"] != _PASS]
    return page_template("calibgraph.fleet").render(
        states=STATES,
        counts=counts,
        vehicles=sorted(listed, key=lambda one: -int(one[1]["state"])),
        newest=max((vehicle["date"] for vehicle in vehicles.values()), default=""),
        moved_lidars=report.moved_lidars,
        mounts=[mount for mounts in report.fleet.mounts.values() for mount in mounts.values()],
        spread_cells=lambda mount: twist_cells(np.sqrt(np.diag(mount.spread)), 3),
    )
