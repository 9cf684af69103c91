"""Is a deployed calibration still right? Measured by images and clouds; nothing is replaced."""

from calibgraph.audit.check import check
from calibgraph.audit.result import Audit, CameraAudit, LidarAudit, audit_summary

__all__ = ["Audit", "CameraAudit", "LidarAudit", "audit_summary", "check"]
