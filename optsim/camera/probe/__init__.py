"""Probes: a small camera and a synthetic scene that predict the sizes of effects before rendering."""

from optsim.camera.probe.frames import FINEST_FIELD, NOTHING, PLAIN, Probe, compared_with
from optsim.camera.probe.made_code import Schemes
from optsim.camera.probe.made_scene import WHITE_OVER_INTERIOR
from optsim.camera.probe.small_camera import (
    Illumination,
    drifted_as_far,
    make_probe,
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
    "Schemes",
    "compared_with",
    "drifted_as_far",
    "make_probe",
    "share_beyond_window",
    "shrunk",
]
