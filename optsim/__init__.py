"""optsim: validate an adaptive pixel-wise coded-exposure camera before its hardware exists.

The four verbs, in the order of use::

    from optsim import load_experiment, render_truth, run, score

    experiment = load_experiment("demo")
    radiance = render_truth(experiment)
    result = run(experiment, radiance)
    print(score(result))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

__version__ = "0.1.0"
__all__ = ["__version__", "load_experiment", "render_truth", "run", "score"]

if TYPE_CHECKING:
    from optsim.experiment import load_experiment
    from optsim.loop import run
    from optsim.scoring import score
    from optsim.truth import render_truth

_HOME = {
    "load_experiment": "experiment",
    "render_truth": "truth",
    "run": "loop",
    "score": "scoring",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used, so that the command line starts quickly."""
    import importlib

    if name in _HOME:
        return getattr(importlib.import_module(f"optsim.{_HOME[name]}"), name)
    raise AttributeError(f"module 'optsim' has no attribute {name!r}")
