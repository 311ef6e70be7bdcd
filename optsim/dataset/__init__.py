"""Data sets: the truth with all its passes, coded frames, and a reader."""

from optsim.dataset.building import build_dataset
from optsim.dataset.export import check_slots, export_passes, parse_slots
from optsim.dataset.extras import Extras, choose_extras
from optsim.dataset.forecast import Forecast, forecast
from optsim.dataset.reading import Dataset, Sample, open_dataset
from optsim.dataset.spec import DatasetSpec, load_spec

__all__ = [
    "Dataset",
    "DatasetSpec",
    "Extras",
    "Forecast",
    "Sample",
    "build_dataset",
    "check_slots",
    "choose_extras",
    "export_passes",
    "forecast",
    "load_spec",
    "open_dataset",
    "parse_slots",
]
