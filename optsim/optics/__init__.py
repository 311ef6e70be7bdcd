"""The camera's optical parts with their true parameters."""

from optsim.optics.chain import leak, leak_budget, stage_transmissions, throughput
from optsim.optics.image_formation import form_image
from optsim.optics.modulator import Modulator
from optsim.optics.objective import Objective
from optsim.optics.relay import Relay
from optsim.optics.splitter import Splitter

__all__ = [
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
