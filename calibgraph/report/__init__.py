"""The report: a result on one HTML page that needs no network."""

from calibgraph.report.frames import relocate_frames as relocate_frames
from calibgraph.report.html import write_report as write_report

__all__ = ["relocate_frames", "write_report"]
