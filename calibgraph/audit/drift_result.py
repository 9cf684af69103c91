"""Several results of one rig: read and checked to be of one; and what their comparison gives."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from calibgraph.arrays import Array
from calibgraph.audit.judgement import CAMERA_AXES
from calibgraph.audit.result import ORDER, CameraAudit, LidarAudit, by_unit, lidar_summary
from calibgraph.errors import CalibrationError
from calibgraph.io.calibrations import load_calibration
from calibgraph.model.calibration import Calibration
from calibgraph.model.result_files import CALIBRATION_FILE
from calibgraph.model.rig import IMAGE_TIMES


@dataclass(frozen=True, eq=False)
class Trend:
    """A steady motion of one camera over all results.

    Attributes:
        changed: whether it is significant, beyond the tolerance over all results, and explains
            them better than changes of single results do.
        reason: one sentence.
        slope: (6,) rotation [rad], translation [m], per unit.
        sigma: (6,) standard deviations of ``slope``.
        unit: "day", or "result" for the order in which they were given.
    """

    changed: bool
    reason: str
    slope: Array
    sigma: Array
    unit: str


@dataclass(frozen=True, eq=False)
class Drift:
    """A comparison of results of one rig.

    Attributes:
        results: their names.
        cameras: per camera, one entry per result.
        trends: per camera with an error bar in three results or more.
        lidar: per result, the motion of the LiDAR where one explains the deviations of all
            cameras; None otherwise.
        tolerance_deg, tolerance_cm: largest turn and shift that are OK.
        false_alarm_rate: probability of one CHANGED or more in this call if nothing has changed.
        same_recording: pairs of results that were made from the same files.
    """

    results: tuple[str, ...]
    cameras: Mapping[str, tuple[CameraAudit, ...]]
    trends: Mapping[str, Trend]
    lidar: tuple[LidarAudit | None, ...]
    tolerance_deg: float
    tolerance_cm: float
    false_alarm_rate: float
    same_recording: tuple[tuple[str, str], ...] = ()

    @property
    def same_recording_note(self) -> str:
        """Sentences on results of one recording; empty if there are none."""
        if not self.same_recording:
            return ""
        pairs = "; ".join(" and ".join(pair) for pair in self.same_recording)
        return (
            f"Made from one recording: {pairs}. They share its errors, and that they agree shows "
            "nothing. Give one result of each recording."
        )

    @property
    def status(self) -> str:
        """The worst of all cameras, results and trends."""
        if any(trend.changed for trend in self.trends.values()):
            return "CHANGED"
        every = (each.status for entries in self.cameras.values() for each in entries)
        return max(every, key=ORDER.index)

    @property
    def changed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a result and what CHANGED there: "LiDAR", or a camera. Without the trends."""
        return tuple(
            (result, name)
            for place, (result, lidar) in enumerate(zip(self.results, self.lidar, strict=True))
            for name in (self.cameras if lidar is None else ["LiDAR"])
            if lidar is not None or self.cameras[name][place].status == "CHANGED"
        )


def drift_summary(drift: Drift) -> dict[str, Any]:
    """A comparison as plain values; every key names its unit, every list is x, y, z."""
    cameras = {}
    for name, entries in drift.cameras.items():
        trend = drift.trends.get(name)
        cameras[name] = {
            "results": {
                result: each.summary(axes=[CAMERA_AXES[axis] for axis in each.axes])
                for result, each in zip(drift.results, entries, strict=True)
            },
            "trend": None if trend is None else {
                "changed": trend.changed, "reason": trend.reason, "per": trend.unit,
                **by_unit("slope", trend.slope), **by_unit("sigma", trend.sigma),
            },
        }  # fmt: skip
    lidars = zip(drift.results, drift.lidar, strict=True)
    return {
        "status": drift.status,
        "changed": [{"result": result, "what": what} for result, what in drift.changed],
        "tolerance_deg": drift.tolerance_deg,
        "tolerance_cm": drift.tolerance_cm,
        "false_alarm_rate": drift.false_alarm_rate,
        "results": list(drift.results),
        "same_recording": [list(pair) for pair in drift.same_recording],
        "cameras": cameras,
        "lidar": {result: lidar_summary(lidar) for result, lidar in lidars if lidar is not None},
    }


Result: TypeAlias = Calibration | Path | str
Results: TypeAlias = Sequence[Result] | Mapping[str, Result]


def open_results(given: Results, *, own_lenses: bool) -> dict[str, Calibration]:
    """The results by their names: those given, of files the paths below their common folder.

    Raises:
        FileError: if one cannot be read.
        CalibrationError: if there are fewer than two, or they are not of one rig.
    """
    names = [*given] if isinstance(given, Mapping) else _names(given)
    items = [*given.values()] if isinstance(given, Mapping) else [*given]
    loaded = [item if isinstance(item, Calibration) else load_calibration(item) for item in items]
    if len(loaded) < 2:  # noqa: PLR2004 - a comparison
        raise CalibrationError(f"{len(loaded)} result given; a comparison needs two or more")
    seen: dict[bytes, str] = {}
    for name, result in zip(names, loaded, strict=True):
        extrinsics = b"".join(T.tobytes() for _, T in sorted(result.T_camera_lidar.items()))
        if extrinsics in seen:  # equal to the last bit: a copy
            raise CalibrationError(
                f"{name}: is the same result as {seen[extrinsics]}; give each once"
            )
        seen[extrinsics] = name
        _require_same_rig(names[0], loaded[0], name, result, own_lenses=own_lenses)
    return dict(zip(names, loaded, strict=True))


def _names(given: Sequence[Result]) -> list[str]:
    """Paths below the common folder; of results in memory their places, from 1."""
    paths = [Path(item).resolve() for item in given if not isinstance(item, Calibration)]
    if len(paths) < len(given) or not paths:
        return [f"result {place}" for place in range(1, len(given) + 1)]
    ends = [path.parent if path.name == CALIBRATION_FILE else path for path in paths]
    if len(set(ends)) < len(ends):
        return [str(item) for item in given]
    common = os.path.commonpath([end.parent for end in ends])
    return [str(end.relative_to(common)) for end in ends]


def _require_same_rig(
    first: str, one: Calibration, name: str, two: Calibration, *, own_lenses: bool
) -> None:
    """Check that two results have the same cameras."""
    a, b = one.rig.cameras, two.rig.cameras
    parts = {"T_camera_lidar", *IMAGE_TIMES}
    parts |= {"intrinsics_px", "distortion"} if own_lenses else set()
    if a.keys() != b.keys():
        raise CalibrationError(
            f"{name}: has the cameras {', '.join(b)}, {first} has {', '.join(a)}; give results of "
            "one rig"
        )
    if two.config.of != one.config.of:
        raise CalibrationError(
            f"{name}: has poses of the {two.config.of}, {first} of the {one.config.of}, which are "
            "different quantities; solve one of them again with the other's --of"
        )
    for camera, other in b.items():
        if other.model_dump(exclude=parts) != a[camera].model_dump(exclude=parts):
            raise CalibrationError(
                f"{name}: camera {camera} has another image size or lens than in {first}, which "
                "would look like a motion; calibrate both with one lens, or give --own-lenses if "
                "they are several vehicles, each with lenses calibrated by themselves"
            )
