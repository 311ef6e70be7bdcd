"""Reports: one page from results.json and its assets, which opens from disk without network."""

from optsim.report.html import write_report
from optsim.report.schema import SCHEMA_VERSION, Picture, Results, Viewer, check_results
from optsim.report.shown import Moment, ViewedFrame, captured_pictures, still_pictures, write_viewer

__all__ = [
    "SCHEMA_VERSION",
    "Moment",
    "Picture",
    "Results",
    "ViewedFrame",
    "Viewer",
    "captured_pictures",
    "check_results",
    "still_pictures",
    "write_report",
    "write_viewer",
]
