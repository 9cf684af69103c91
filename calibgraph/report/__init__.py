"""The report: everything that is known of a result, on one page that needs no network."""

from calibgraph.report.frame_errors import with_files_of as with_files_of
from calibgraph.report.html import write_report as write_report

__all__ = ["with_files_of", "write_report"]
