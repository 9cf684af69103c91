"""Are error bars as wide as errors are, rig by rig, and does a size read from other rigs help?

    python -m benchmarks.accuracy.left_out_rigs out/search.jsonl out/street_verdicts.jsonl

Records are of any benchmark that keeps errors and covariances per camera; those made wrong take no
part, nor cameras without an error bar or farther off than 1 degree or 25 cm, which were not found.
Recordings of one vehicle are one rig, and so is each kind of rendered rig. A rig's size is the mean
squared error in the covariance, of rotation and of position apart, over 3: by so much its variances
are too small. The size of the others is the geometric mean of theirs, each rig once. With it, the
logarithm of the density of a left-out rig's errors rises, or falls.
Stated regions should hold the share of the results that they state.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.accuracy import ledger
from benchmarks.accuracy.ledger import Record
from benchmarks.tables import Table, parser_of

Array = NDArray[np.float64]

NOT_FOUND = (1.0, 25.0)  # deg, cm
KITTI = ("00", "01", "05", "06", "07", "08", "10")
RIGS = ("pair", "sample", "wide", "sector")
REGIONS = (0.5, 0.8, 0.95)
PARTS = (slice(0, 3), slice(3, 6))


def main() -> None:
    """Read records, print the tables."""
    parser = parser_of(__doc__)
    parser.add_argument("records", type=Path, nargs="+", help="files of other benchmarks")
    options = parser.parse_args()
    records = [record for path in options.records for record in ledger.read(path)]
    found = errors_of(records)
    tables = [left_out(found), reliability(found)]
    ledger.publish_cases(tables, records)


def errors_of(records: Iterable[Record]) -> dict[str, Array]:
    """Per rig (n, 3): squared errors of rotation, position and both, over their axes."""
    groups: dict[str, list[Array]] = {}
    for record in records:
        for camera in record.get("cameras", {}).values():
            if record["kind"].startswith(("good", *RIGS)) and _found(camera):
                groups.setdefault(rig_of(record), []).append(_squared(camera))
    return {rig: np.array(rows) for rig, rows in sorted(groups.items())}


def rig_of(record: Record) -> str:
    """The vehicle of a recording; the kind of a rendered rig, with the number of its places."""
    if record["level"] == "streets":
        return f"rendered {RIGS[record['seed'] % len(RIGS)]}, places: {record['places']}"
    if record["level"] == "scene":
        return f"rendered {record['kind']}, places: 1"
    parts = record["data"].split("+")
    return "KITTI odometry" if set(parts) <= {*KITTI} else str(record["data"])


def _found(camera: Record) -> bool:
    near = camera["error_deg"] <= NOT_FOUND[0] and camera["error_cm"] <= NOT_FOUND[1]
    return bool(camera["covariance"] is not None and camera["status"] != "FAIL" and near)


def _squared(camera: Record) -> Array:
    """(3,) of rotation, position and both, each over its number of axes."""
    xi = np.concatenate([np.radians(camera["xi_deg"]), 0.01 * np.array(camera["xi_cm"])])
    covariance = np.array(camera["covariance"])
    return np.array([
        xi[rows] @ np.linalg.solve(covariance[rows, rows], xi[rows]) / len(xi[rows])
        for rows in (*PARTS, slice(0, 6))
    ])  # fmt: skip


def left_out(found: Mapping[str, Array]) -> Table:
    """A row per rig: its error size, the others' size, and what the latter adds to log density."""
    rows, sizes = [], {rig: own[:, :2].mean(axis=0) for rig, own in found.items()}
    for rig, own in found.items():
        others = np.exp(np.mean([np.log(size) for r, size in sizes.items() if r != rig], axis=0))
        values = (own[:, 2].mean(), *sizes[rig], *others)
        rows.append((rig, str(len(own)), *(f"{value:.2f}" for value in values),
                     f"{gained(own[:, :2], others):+.2f}"))  # fmt: skip
    return Table(
        "Squared errors in their covariances, and with the sizes of the other rigs",
        ("rig", "results", "over 6", "rotation, over 3", "position, over 3",
         "the others': rotation", "position", "gain of log density"),
        tuple(rows),
    )  # fmt: skip


def gained(parts: Array, sizes: Array) -> float:
    """The mean gain of the log density of errors if their variances are multiplied by sizes.

    Args:
        parts: (n, 2) squared errors over 3.
        sizes: (2,).
    """
    return float(np.mean(1.5 * (parts * (1 - 1 / sizes) - np.log(sizes)).sum(axis=1)))


def reliability(found: Mapping[str, Array]) -> Table:
    """A row per rig: the share of its results inside the regions that error bars state."""
    limits = [chi2.ppf(share, 6) / 6 for share in REGIONS]
    rows = [
        (rig, str(len(own)), *(f"{np.mean(own[:, 2] <= limit):.0%}" for limit in limits))
        for rig, own in found.items()
    ]
    columns = ("rig", "results", *(f"{share:.0%}" for share in REGIONS))
    return Table("Results inside the regions that error bars state", columns, tuple(rows))


if __name__ == "__main__":
    main()
