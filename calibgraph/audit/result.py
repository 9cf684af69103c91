"""The result of an audit: per camera and axis the measurement, and its status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calibgraph.arrays import Array
from calibgraph.io.frame import Frame
from calibgraph.model.rig import Rig
from calibgraph.model.verdict import Status, fixed

ORDER = ("OK", "CANNOT TELL", "CHANGED", "WRONG")


@dataclass(frozen=True, eq=False)
class CameraAudit:
    """A camera's pose, or that of a LiDAR, compared with another one of it.

    Of the base LiDAR, or the only one: its motion in its own axes, where it alone explains how all
    other sensors deviate.

    Attributes:
        status: OK, CANNOT TELL, or what deviates: WRONG of ``check``, CHANGED of ``drift``.
        reason: one sentence: what was found and, where nothing can be told, what to record.
        deviation: (6,) xi in T_other_here = exp(xi), the pose of the camera now in its frame as
            deployed, or by one result in its frame by the others: rotation [rad], translation [m];
            None if nothing was measured.
        sigma: (6,) standard deviations of ``deviation``; None without an error bar.
        detectable: (6,) smallest change per axis that these data tell from none, with 90 %
            probability; None without an error bar.
        z_score: agreement of image and cloud at the measured extrinsic; None if unknown.
        axes: of ``drift``, which of the six CHANGED, in this order.
    """

    status: str
    reason: str
    deviation: Array | None = None
    sigma: Array | None = None
    detectable: Array | None = None
    z_score: float | None = None
    axes: tuple[int, ...] = ()

    def summary(self, **own: object) -> dict[str, Any]:
        """As plain values, with those of a kind of comparison."""
        return {
            "status": self.status,
            "reason": self.reason,
            **own,
            **by_unit("deviation", self.deviation),
            **by_unit("sigma", self.sigma),
            **by_unit("detectable", self.detectable),
        }


@dataclass(frozen=True, eq=False)
class Audit:
    """The audit of a rig.

    Attributes:
        cameras: per camera.
        lidar: its motion where it explains all deviations; None otherwise.
        deployed: the rig that was compared.
        shown: the frame that a page shows, in the middle of the recording.
        recording: the sources of the frames.
        tolerance_deg, tolerance_cm: largest turn and shift that are OK.
        frames: number of frames that were matched.
        timings_s: wall time per stage.
        same_recording: whether the deployed calibration was made from these very frames, so that
            errors that they repeat cannot be seen.
        deployed_verdict: of the result that is deployed, when it was made; None of other rigs.
        lidars: per LiDAR but the base, if there are several; the motion of the base is ``lidar``.
    """

    cameras: Mapping[str, CameraAudit]
    lidar: CameraAudit | None
    deployed: Rig
    shown: Frame
    recording: tuple[str, ...]
    tolerance_deg: float
    tolerance_cm: float
    frames: int
    timings_s: Mapping[str, float] = field(default_factory=dict)
    same_recording: bool = False
    deployed_verdict: Status | None = None
    lidars: Mapping[str, CameraAudit] = field(default_factory=dict)

    @property
    def sensors(self) -> dict[str, CameraAudit]:
        """Cameras, and LiDARs but the base."""
        return {**self.cameras, **self.lidars}

    @property
    def status(self) -> str:
        """The worst of the sensors."""
        return max((sensor.status for sensor in self.sensors.values()), key=ORDER.index)

    @property
    def wrong(self) -> tuple[str, ...]:
        """The names that are WRONG: the LiDAR alone, of several the base; or other sensors."""
        if self.lidar is not None:
            return (self.deployed.lidar if self.lidars else "LiDAR",)
        return self.with_status("WRONG")

    @property
    def lidar_reason(self) -> str:
        """How the LiDAR moved, in a sentence; empty if it did not."""
        agree = "all other sensors agree" if self.lidars else "all cameras agree"
        return "" if self.lidar is None else f"{self.lidar.reason}; {agree} on it"

    def with_status(self, status: str) -> tuple[str, ...]:
        """The names of sensors."""
        return tuple(name for name, sensor in self.sensors.items() if sensor.status == status)

    @property
    def same_recording_note(self) -> str:
        """Sentences on what the recording of the result itself cannot show; empty for another."""
        if not self.same_recording:
            return ""
        return (
            "It was made from this recording, which repeats its own errors and cannot show them. "
            "Check it on another one."
        )

    @property
    def deployed_verdict_note(self) -> str:
        """Sentences on a deployed result that was not PASS; empty if it was, or is unknown."""
        if self.deployed_verdict in (None, "PASS"):
            return ""
        return (
            f"This result was {self.deployed_verdict} when it was made, and its report says why. A "
            "lens and an extrinsic that are wrong together would look right here."
        )


def audit_summary(audit: Audit) -> dict[str, Any]:
    """An audit as plain values; every key names its unit, every list is x, y, z."""
    return {
        "status": audit.status,
        "wrong": list(audit.wrong),
        "tolerance_deg": audit.tolerance_deg,
        "tolerance_cm": audit.tolerance_cm,
        "frames": audit.frames,
        "same_recording": audit.same_recording,
        "deployed_verdict": audit.deployed_verdict,
        "cameras": {
            name: camera.summary(z_score=camera.z_score) for name, camera in audit.cameras.items()
        },
        "lidar": None if audit.lidar is None else lidar_summary(audit.lidar),
        "lidars": {name: lidar.summary() for name, lidar in audit.lidars.items()},
        "timings_s": dict(audit.timings_s),
    }


def lidar_summary(lidar: CameraAudit) -> dict[str, Any]:
    """A motion of the LiDAR as plain values."""
    twists = {**by_unit("motion", lidar.deviation), **by_unit("sigma", lidar.sigma)}
    return {"reason": lidar.reason, **twists}


def by_unit(name: str, twist: Array | None) -> dict[str, list[float] | None]:
    """A (6,) of rotations and translations in degrees and centimetres."""
    return {
        f"{name}_deg": None if twist is None else np.degrees(twist[:3]).tolist(),
        f"{name}_cm": None if twist is None else (100.0 * twist[3:]).tolist(),
    }


def twist_cells(twist: Array | None, decimals: int, sign: str = "") -> list[str]:
    """Six numbers in degrees and centimetres; dashes if there are none."""
    if twist is None:
        return ["-"] * 6
    numbers = (*np.degrees(twist[:3]), *(100 * twist[3:]))
    return [fixed(value, decimals, sign) for value in numbers]
