# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Renderer: Scene -> radiance video. It alone uses Mitsuba and Dr.Jit, and imports them inside functions."""

import lazy_loader

# Names of __init__.pyi are imported at their first use: `optsim explain` needs no renderer.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
