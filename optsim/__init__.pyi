from .experiment import load_experiment
from .loop import run
from .scoring import score
from .truth import render_truth

__version__: str
__all__ = ["__version__", "load_experiment", "render_truth", "run", "score"]
