"""The tables of ``accuracy.audit``."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import mean

import numpy as np
from scipy.special import ndtr

from benchmarks.accuracy.ledger import Record
from benchmarks.tables import Table
from calibgraph.audit.judgement import CAMERA_AXES
from calibgraph.audit.significance import FALSE_ALARM_RATE, POWER

AXES = [
    f"{name} [{unit}]" for name, unit in zip(CAMERA_AXES, ["deg"] * 3 + ["cm"] * 3, strict=True)
]
STATUSES = ("OK", "CANNOT TELL", "WRONG")


def report(records: Sequence[Record]) -> list[Table]:
    """All tables."""
    done = [record for record in records if "cameras" in record]
    right, camera, lidar, multiple = (
        [record for record in done if record["level"] == level]
        for level in ("right", "camera", "LiDAR", "detectable")
    )
    return [
        nothing_displaced(right), scatter(right), false_alarms(right),
        by_size("One camera displaced", camera, _own), by_axis(camera),
        at_detectable(multiple), by_size("The LiDAR displaced", lidar, _all),
    ]  # fmt: skip


def _all(record: Record) -> list[Record]:
    return [*record["cameras"].values()]


def _own(record: Record) -> list[Record]:
    return [record["cameras"][record["of"]]]


def _others(record: Record) -> list[Record]:
    return [camera for name, camera in record["cameras"].items() if name != record["of"]]


def _trusted(cameras: Sequence[Record]) -> list[Record]:
    return [camera for camera in cameras if camera["trusted"]]


def _alarms(camera: Record) -> int:
    """How many axes are significant."""
    return sum(camera["significant"])


def _group(record: Record) -> str:
    """What is deployed, in words."""
    if record["kind"] == "truth":
        return "rendered, truth"
    return "recording, " + ("reference" if record["kind"] == "reference" else "another's result")


def nothing_displaced(records: Sequence[Record]) -> Table:
    """A row per kind of what is deployed."""
    rows = []
    for group in sorted({_group(record) for record in records}):
        own = [record for record in records if _group(record) == group]
        cameras = [camera for record in own for camera in _all(record)]
        trusted = _trusted(cameras)
        rigs = [record for record in own if _trusted(_all(record))]
        alarmed = [record for record in rigs if any(map(_alarms, _trusted(_all(record))))]
        rows.append((
            group, str(len(own)), str(len(rigs)), str(len(alarmed)), str(len(trusted)),
            f"{sum(map(_alarms, trusted))} of {6 * len(trusted)}", *_statuses(cameras),
        ))  # fmt: skip
    columns = (
        "what is deployed", "rigs", "measured", "with a significant axis", "cameras measured",
        "significant axes", *(f"cameras {status}" for status in STATUSES),
    )  # fmt: skip
    stated = f"stated: {FALSE_ALARM_RATE:.1%} of rigs have a significant axis"
    return Table(f"Nothing displaced ({stated})", columns, tuple(rows))


def _statuses(cameras: Sequence[Record]) -> Iterator[str]:
    for status in STATUSES:
        yield str(sum(camera["status"] == status for camera in cameras))


def _column(cameras: Sequence[Record], name: str) -> np.ndarray:
    """(n, 6) a quantity of cameras in degrees and centimetres."""
    rows = [[*camera[f"{name}_deg"], *camera[f"{name}_cm"]] for camera in cameras]
    return np.array(rows).reshape(-1, 6)


def scatter(records: Sequence[Record]) -> Table:
    """A row per kind of what is deployed and axis: deviations beside their sigmas."""
    rows = []
    for group in sorted({_group(record) for record in records}):
        own = [_trusted(_all(record)) for record in records if _group(record) == group]
        cameras = [camera for trusted in own for camera in trusted]
        deviation, sigma = _column(cameras, "deviation"), _column(cameras, "sigma")
        for axis, name in enumerate(AXES if cameras else ()):
            ratio = deviation[:, axis] / sigma[:, axis]
            values = _rms(deviation[:, axis]), _rms(sigma[:, axis]), _rms(ratio), max(abs(ratio))
            limit = np.median(_column(cameras, "limit")[:, axis] / sigma[:, axis])
            rows.append((group, name, *(f"{value:.2f}" for value in (*values, limit))))
    columns = (
        "what is deployed", "axis", "deviation, rms", "sigma, rms", "ratio, rms", "ratio, largest",
        "ratio that is significant, median",
    )  # fmt: skip
    return Table("Nothing displaced: deviations and sigmas", columns, tuple(rows))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def false_alarms(records: Sequence[Record]) -> Table:
    """A row per significant axis where nothing is displaced."""
    rows = []
    for record in records:
        for name, camera in record["cameras"].items():
            if camera["trusted"]:
                found, sigma = _column([camera], "deviation")[0], _column([camera], "sigma")[0]
                rows += [
                    (record["data"], record["kind"], name, AXES[axis], f"{found[axis]:+.2f}",
                     f"{sigma[axis]:.2f}", camera["status"])
                    for axis in np.flatnonzero(camera["significant"])
                ]  # fmt: skip
    columns = ("data", "deployed", "camera", "axis", "deviation", "sigma", "status")
    return Table("Nothing displaced: significant axes", columns, tuple(rows))


def by_size(
    title: str, records: Sequence[Record], moved: Callable[[Record], list[Record]]
) -> Table:
    """A row per size of a displacement.

    Args:
        title: of the table.
        records: of displacements.
        moved: which cameras of an audit moved.
    """
    rows = []
    for unit, axes in (("deg", range(3)), ("cm", range(3, 6))):
        of_unit = [record for record in records if record["axis"] in axes]
        for size in sorted({abs(round(record["size"], 6)) for record in of_unit}):
            own = [record for record in of_unit if abs(abs(record["size"]) - size) < 1e-6]
            rows.append((f"{size:g} {unit}", *_row_of_size(own, moved)))
    columns = (
        "displaced by", "audits", "measured", "an axis significant", "WRONG", "culprit alone named",
        "CANNOT TELL", "OK", "others OK", "others WRONG",
    )  # fmt: skip
    return Table(title, columns, tuple(rows))


def _row_of_size(own: Sequence[Record], moved: Callable[[Record], list[Record]]) -> tuple[str, ...]:
    """The worst status counts of the cameras that moved."""
    measured = [record for record in own if len(_trusted(moved(record))) == len(moved(record))]
    significant = sum(any(map(_alarms, moved(record))) for record in measured)
    worst = [max((c["status"] for c in moved(record)), key=STATUSES.index) for record in own]
    others = [camera for record in own for camera in _others(record) if moved is _own]
    named = sum(record["wrong"] == [record["of"]] for record in own)
    return (
        str(len(own)), str(len(measured)), str(significant), str(worst.count("WRONG")), str(named),
        str(worst.count("CANNOT TELL")), str(worst.count("OK")),
        *(f"{sum(c['status'] == status for c in others)} of {len(others)}" if others else ""
          for status in ("OK", "WRONG")),
    )  # fmt: skip


def _found(records: Sequence[Record]) -> tuple[int, int, float]:
    """How often the displaced axis is significant, of how many, and how often it is expected."""
    cameras = [
        (record, *_trusted(_own(record))) for record in records if _own(record)[0]["trusted"]
    ]
    if not cameras:
        return 0, 0, float("nan")
    found = sum(camera["significant"][record["axis"]] for record, camera in cameras)
    return found, len(cameras), mean(_chance(record, camera) for record, camera in cameras)


def _chance(record: Record, camera: Record) -> float:
    """That the displacement is significant if the error bar is right."""
    axis, size = record["axis"], abs(record["size"])
    limit, sigma = (_column([camera], name)[0, axis] for name in ("limit", "sigma"))
    return float(ndtr((size - limit) / sigma) + ndtr((-size - limit) / sigma))


def by_axis(records: Sequence[Record]) -> Table:
    """A row per axis: how often it was significant, by steps of size."""
    rows = []
    groups = [(name, (axis,)) for axis, name in enumerate(AXES)]
    for name, axes in (*groups, ("all rotations [deg]", range(3)), ("all [cm]", range(3, 6))):
        own = [record for record in records if record["axis"] in axes]
        rows += [(name, *row) for row in _rows_of_found(own, lambda record: record["size"])]
    columns = ("axis", "displaced by", "measured", "significant", "expected by the error bar")
    return Table("One camera displaced: its axis is significant", columns, tuple(rows))


def at_detectable(records: Sequence[Record]) -> Table:
    """A row per axis and multiple of the detectable change, and those of all axes."""

    def times(record: Record) -> float:
        return float(record["kind"].split(":")[1])

    rows = []
    for axis, name in (*enumerate(AXES), (None, "all")):
        own = [record for record in records if axis in (None, record["axis"])]
        rows += [(name.split(" [")[0], *row) for row in _rows_of_found(own, times)]
    columns = ("axis", "times", "measured", "significant", "expected by the error bar")
    title = "One camera displaced by multiples of the stated smallest detectable change"
    return Table(f"{title} (at 1: stated {POWER:.0%})", columns, tuple(rows))


def _rows_of_found(
    records: Sequence[Record], size_of: Callable[[Record], float]
) -> Iterator[tuple[str, ...]]:
    """Per absolute size: measured, significant, expected."""
    sizes = [abs(round(size_of(record), 6)) for record in records]
    for size in sorted(set(sizes)):
        own = [record for record, its in zip(records, sizes, strict=True) if its == size]
        found, count, expected = _found(own)
        yield f"{size:g}", str(count), str(found), f"{expected:.0%}"
