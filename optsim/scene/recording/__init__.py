"""Recordings as they lie on disk: files in, frames as stored out; what they mean is ``footage_source``'s."""

from optsim.scene.recording.arrays import array_axes, array_names, load_array
from optsim.scene.recording.files import IMAGES, by_number, open_recording
from optsim.scene.recording.film import Recording, Says

__all__ = [
    "IMAGES",
    "Recording",
    "Says",
    "array_axes",
    "array_names",
    "by_number",
    "load_array",
    "open_recording",
]
