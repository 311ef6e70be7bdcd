from .experiment.experiment import load_experiment
from .experiment.loop import run
from .experiment.scoring import score
from .experiment.truth import render_truth

__version__: str
__all__ = ["__version__", "load_experiment", "render_truth", "run", "score"]
