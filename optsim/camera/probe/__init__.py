"""Small cameras that stand for a large one, and what a change of the camera does to their frames."""

from optsim.camera.probe.frames import (
    FINEST_FIELD,
    NOTHING,
    PLAIN,
    Probe,
    Probes,
    Which,
    compared_with,
    shown_on,
)
from optsim.camera.probe.made_code import Schemes
from optsim.camera.probe.made_scene import WHITE_OVER_INTERIOR
from optsim.camera.probe.small_cameras import (
    Illumination,
    drifted_as_far,
    far_pixel,
    far_probe,
    make_probes,
    near_probe,
    share_beyond_window,
    shrunk,
)

__all__ = [
    "FINEST_FIELD",
    "NOTHING",
    "PLAIN",
    "WHITE_OVER_INTERIOR",
    "Illumination",
    "Probe",
    "Probes",
    "Schemes",
    "Which",
    "compared_with",
    "drifted_as_far",
    "far_pixel",
    "far_probe",
    "make_probes",
    "near_probe",
    "share_beyond_window",
    "shown_on",
    "shrunk",
]
