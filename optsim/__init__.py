# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""optsim: validate an adaptive pixel-wise coded-exposure camera before its hardware exists.

The four verbs, in the order of use::

    from optsim import load_experiment, render_truth, run, score

    experiment = load_experiment("demo")
    radiance = render_truth(experiment)
    result = run(experiment, radiance)
    print(score(result))
"""

import lazy_loader

__version__ = "0.1.0"
# What __init__.pyi names is imported when it is first used, so that the command line starts quickly.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
