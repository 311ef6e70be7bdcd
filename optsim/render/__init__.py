"""Scene -> radiance: the only room that knows Mitsuba and Dr.Jit, which it imports inside functions."""

from optsim.render.backend import BackendReport, choose_backend
from optsim.render.flow import PassRenderer, render_passes
from optsim.render.full import render_footage
from optsim.render.settings import CameraNoise, RenderSettings
from optsim.render.truth import render_truth

__all__ = [
    "BackendReport",
    "CameraNoise",
    "PassRenderer",
    "RenderSettings",
    "choose_backend",
    "render_footage",
    "render_passes",
    "render_truth",
]
