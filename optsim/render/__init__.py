# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Scene -> radiance: the only room that knows Mitsuba and Dr.Jit, which it imports inside functions."""

import lazy_loader

# What __init__.pyi names is imported when it is first used: `optsim explain` needs nothing that renders.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
