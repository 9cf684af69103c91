"""Is a calibration still right? Measured by images and clouds, or by several results."""

from calibgraph.audit.check import check
from calibgraph.audit.drift import Drift, drift, drift_summary
from calibgraph.audit.result import Audit, CameraAudit, audit_summary

__all__ = [
    "Audit",
    "CameraAudit",
    "Drift",
    "audit_summary",
    "check",
    "drift",
    "drift_summary",
]
