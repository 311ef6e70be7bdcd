# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""optsim: validate an adaptive pixel-wise coded-exposure camera before its hardware exists.

The four verbs, in the order of use::

    from optsim import load_experiment, render_truth, run, score

    experiment = load_experiment("demo")
    radiance = render_truth(experiment)
    result = run(experiment, radiance)
    print(score(result))
"""

import importlib
import sys
import warnings
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

import lazy_loader

__version__ = "0.1.0"
# What __init__.pyi names is imported when it is first used, so that the command line starts quickly.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

# Rooms that had another name, and where they are now; old names warn.
_MOVED = {
    "optsim.calibrate": "optsim.calibration",
    "optsim.forward": "optsim.optics",
    "optsim.measurement": "optsim.experiment.measurement",
    "optsim.passes": "optsim.dataset",
    "optsim.quantities": "optsim.core.quantities",
    "optsim.reconstruct": "optsim.decoding",
    "optsim.sensor": "optsim.camera.parts",
}


class _OldNames(MetaPathFinder, Loader):
    """Finds a room by its old name."""

    def find_spec(self, name: str, path: object, target: object = None) -> ModuleSpec | None:
        return ModuleSpec(name, self) if name in _MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        name = module.__name__
        warnings.warn(f"{name} is {_MOVED[name]} now", DeprecationWarning, stacklevel=2)
        sys.modules[name] = importlib.import_module(_MOVED[name])


# First: folders of old rooms may still hold compiled files.
sys.meta_path.insert(0, _OldNames())
