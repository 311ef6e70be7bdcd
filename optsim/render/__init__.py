"""Scene -> radiance: the only room that knows Mitsuba and Dr.Jit, which it imports inside functions."""

from optsim.render.backend import BackendReport, choose_backend
from optsim.render.plain import render_footage
from optsim.render.settings import RenderSettings
from optsim.render.truth import render_truth

__all__ = ["BackendReport", "RenderSettings", "choose_backend", "render_footage", "render_truth"]
