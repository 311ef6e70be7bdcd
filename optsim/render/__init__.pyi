from .backend import BackendReport, choose_backend
from .flow import PassRenderer, render_passes
from .full import render_footage
from .settings import CameraNoise, RenderSettings
from .truth import render_truth

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
