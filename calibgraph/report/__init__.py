"""The report: everything that is known of a result, on one page that needs no network."""

from calibgraph.report.page import write_report as write_report
from calibgraph.report.shown import with_files_of as with_files_of

__all__ = ["with_files_of", "write_report"]
