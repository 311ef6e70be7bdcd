"""Recordings on disk: files in, frames as stored out; ``footage_source`` states their meaning."""

from optsim.footage.recording.arrays import array_axes, array_names, load_array
from optsim.footage.recording.files import IMAGES, VIDEOS, by_number, naming, open_recording
from optsim.footage.recording.film import RAW_COUNTS, FileStatement, Recording

__all__ = [
    "IMAGES",
    "RAW_COUNTS",
    "VIDEOS",
    "FileStatement",
    "Recording",
    "array_axes",
    "array_names",
    "by_number",
    "load_array",
    "naming",
    "open_recording",
]
