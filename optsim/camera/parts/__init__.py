"""The camera's parts with their true parameters: objective, splitter, modulator, relay and CCD."""

from typing import Annotated

from optsim.camera.parts.ccd import Ccd
from optsim.camera.parts.chain import leak, leak_budget, stage_transmissions, throughput
from optsim.camera.parts.image_formation import form_image
from optsim.camera.parts.modulator import Modulator
from optsim.camera.parts.objective import Objective
from optsim.camera.parts.relay import Relay
from optsim.camera.parts.splitter import Splitter
from optsim.core.extensions import AS_IT_IS, PARTS, or_offered

# Each may be a subclass that another package offers, by its ``kind``.
AnyObjective = Annotated[Objective, or_offered(PARTS, Objective), AS_IT_IS]
AnySplitter = Annotated[Splitter, or_offered(PARTS, Splitter), AS_IT_IS]
AnyModulator = Annotated[Modulator, or_offered(PARTS, Modulator), AS_IT_IS]
AnyRelay = Annotated[Relay, or_offered(PARTS, Relay), AS_IT_IS]
AnyCcd = Annotated[Ccd, or_offered(PARTS, Ccd), AS_IT_IS]

__all__ = [
    "AnyCcd",
    "AnyModulator",
    "AnyObjective",
    "AnyRelay",
    "AnySplitter",
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
