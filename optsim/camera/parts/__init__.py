"""The camera's parts with their true parameters: objective, splitter, modulator, relay and CCD."""

from optsim.camera.parts.ccd import Ccd
from optsim.camera.parts.chain import leak, leak_budget, stage_transmissions, throughput
from optsim.camera.parts.image_formation import form_image
from optsim.camera.parts.modulator import Modulator
from optsim.camera.parts.objective import Objective
from optsim.camera.parts.relay import Relay
from optsim.camera.parts.splitter import Splitter

__all__ = [
    "Ccd",
    "Modulator",
    "Objective",
    "Relay",
    "Splitter",
    "form_image",
    "leak",
    "leak_budget",
    "stage_transmissions",
    "throughput",
]
