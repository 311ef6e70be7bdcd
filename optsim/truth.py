"""From an experiment to its rendered truth, through the cache."""

from __future__ import annotations

from optsim.cache import Cache
from optsim.experiment import Experiment
from optsim.progress import Progress, silent
from optsim.quantities import RadianceVideo


def render_truth(
    experiment: Experiment, *, backend: str | None = None, progress: Progress = silent
) -> RadianceVideo:
    """Render the HDR high-speed radiance of an experiment's scene, or find it in the cache.

    Parameters
    ----------
    experiment : Experiment
        Its scene, render settings, field of view and timing decide the truth; codes don't.
    backend : str, optional
        Mitsuba variant to use instead of the one chosen by probing.
    progress : Progress
        Told of each finished pose.

    Returns
    -------
    RadianceVideo
        Lazy: poses stay in the cache until a segment is asked for.

    Raises
    ------
    BackendError
        When no renderer backend works.
    """
    from optsim import render, scene

    return render.render_truth(
        scene.load_scene(experiment.scene.name, experiment.scene.variation),
        experiment.camera.view,
        experiment.timing,
        experiment.render,
        cache=Cache(),
        backend=backend,
        progress=progress,
    )
