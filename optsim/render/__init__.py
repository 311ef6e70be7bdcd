"""Scene -> radiance: the only room that knows Mitsuba and Dr.Jit, which it imports inside functions."""

from __future__ import annotations

from typing import TYPE_CHECKING

from optsim.render.settings import CameraNoise, RenderSettings

if TYPE_CHECKING:
    from optsim.render.backend import BackendReport, choose_backend
    from optsim.render.flow import PassRenderer, render_passes
    from optsim.render.full import render_footage
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
_HOME = {
    "BackendReport": "backend",
    "PassRenderer": "flow",
    "choose_backend": "backend",
    "render_footage": "full",
    "render_passes": "flow",
    "render_truth": "truth",
}


def __getattr__(name: str) -> object:
    """Import what renders when it is first used: ``optsim explain`` needs none of it."""
    import importlib

    if name in _HOME:
        return getattr(importlib.import_module(f"optsim.render.{_HOME[name]}"), name)
    raise AttributeError(f"module 'optsim.render' has no attribute {name!r}")
