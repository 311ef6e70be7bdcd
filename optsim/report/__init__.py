"""Reports: one page from results.json and its images, which opens from disk without network."""

from optsim.report.animation import animate
from optsim.report.html import write_report
from optsim.report.pictures import ToneCurve, tone_curve_for
from optsim.report.schema import SCHEMA_VERSION, Picture, Results, check_results
from optsim.report.sheet import Crop, Moment, Shot, choose_crops, render_pictures

__all__ = [
    "SCHEMA_VERSION",
    "Crop",
    "Moment",
    "Picture",
    "Results",
    "Shot",
    "ToneCurve",
    "animate",
    "check_results",
    "choose_crops",
    "render_pictures",
    "tone_curve_for",
    "write_report",
]
