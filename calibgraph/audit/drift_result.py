"""The comparison of several results: per camera and result the deviation and its status."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from calibgraph.arrays import Array
from calibgraph.audit.judgement import CAMERA_AXES
from calibgraph.audit.result import LidarAudit, by_unit, freeze, lidar_summary

DriftStatus = Literal["OK", "CANNOT TELL", "CHANGED"]

_ORDER: tuple[DriftStatus, ...] = ("OK", "CANNOT TELL", "CHANGED")


@dataclass(frozen=True, eq=False)
class CameraDrift:
    """One camera in one result.

    Attributes:
        status: OK, CANNOT TELL or CHANGED.
        reason: one sentence: what was found and, where nothing can be told, what to record.
        deviation: (6,) xi in T_others_here = exp(xi), the pose of the camera by this result in its
            frame by the other results: rotation [rad], translation [m]; None if not compared.
        sigma: (6,) standard deviations of ``deviation``.
        detectable: (6,) smallest change per axis that would be significant with 90 % probability.
        axes: which of the six CHANGED, in this order.
    """

    status: DriftStatus
    reason: str
    deviation: Array | None = None
    sigma: Array | None = None
    detectable: Array | None = None
    axes: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        freeze(self.deviation, self.sigma, self.detectable)


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
        span: from the first to the last result, in this unit.
    """

    changed: bool
    reason: str
    slope: Array
    sigma: Array
    unit: str
    span: float

    def __post_init__(self) -> None:
        freeze(self.slope, self.sigma)


@dataclass(frozen=True, eq=False)
class Drift:
    """A comparison of results of one rig.

    Attributes:
        results: their names.
        at: (n,) when each was recorded [days], or its place in the order given.
        cameras: per camera, one entry per result.
        trends: per camera with an error bar in three results or more.
        lidar: per result, the motion of the LiDAR where one explains the deviations of all
            cameras; None otherwise.
        tolerance_deg, tolerance_cm: largest deviation per axis that is OK.
        false_alarm_rate: probability of one CHANGED or more in this call if nothing has changed.
    """

    results: tuple[str, ...]
    at: Array
    cameras: Mapping[str, tuple[CameraDrift, ...]]
    trends: Mapping[str, Trend]
    lidar: tuple[LidarAudit | None, ...]
    tolerance_deg: float
    tolerance_cm: float
    false_alarm_rate: float

    @property
    def status(self) -> DriftStatus:
        """The worst of all cameras, results and trends."""
        if any(trend.changed for trend in self.trends.values()):
            return "CHANGED"
        return max((each.status for entries in self.cameras.values() for each in entries),
                   key=_ORDER.index)  # fmt: skip

    @property
    def changed(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a result and what CHANGED there: "LiDAR", or a camera. Without the trends."""
        found = []
        for place, (result, lidar) in enumerate(zip(self.results, self.lidar, strict=True)):
            moved = [name for name, each in self.cameras.items()
                     if each[place].status == "CHANGED"]  # fmt: skip
            found += [(result, name) for name in (moved if lidar is None else ["LiDAR"])]
        return tuple(found)


def drift_summary(drift: Drift) -> dict[str, Any]:
    """A comparison as plain values; every key names its unit, every list is x, y, z."""
    return {
        "status": drift.status,
        "changed": [{"result": result, "what": what} for result, what in drift.changed],
        "tolerance_deg": drift.tolerance_deg,
        "tolerance_cm": drift.tolerance_cm,
        "false_alarm_rate": drift.false_alarm_rate,
        "results": list(drift.results),
        "cameras": {
            name: {
                "results": {
                    result: _camera_summary(each)
                    for result, each in zip(drift.results, entries, strict=True)
                },
                "trend": _trend_summary(drift.trends.get(name)),
            }
            for name, entries in drift.cameras.items()
        },
        "lidar": {
            result: lidar_summary(lidar)
            for result, lidar in zip(drift.results, drift.lidar, strict=True)
            if lidar is not None
        },
    }


def _camera_summary(camera: CameraDrift) -> dict[str, Any]:
    return {
        "status": camera.status,
        "reason": camera.reason,
        "axes": [CAMERA_AXES[axis] for axis in camera.axes],
        **by_unit("deviation", camera.deviation),
        **by_unit("sigma", camera.sigma),
        **by_unit("detectable", camera.detectable),
    }


def _trend_summary(trend: Trend | None) -> dict[str, Any] | None:
    if trend is None:
        return None
    return {
        "changed": trend.changed,
        "reason": trend.reason,
        "per": trend.unit,
        **by_unit("slope", trend.slope),
        **by_unit("sigma", trend.sigma),
    }
