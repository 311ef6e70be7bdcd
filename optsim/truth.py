"""Where an experiment's truth comes from: a scene, rendered through the cache, or recorded footage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from optsim.cache import Cache
from optsim.errors import ConfigError
from optsim.experiment import Experiment, Source
from optsim.probe import WHITE_OVER_INTERIOR, Illumination
from optsim.progress import Progress, silent
from optsim.quantities import RadianceVideo
from optsim.scene import (
    MONO_NM,
    BrightLight,
    FootageTruth,
    Scene,
    brightest_light,
    load_scene,
    open_footage,
)

if TYPE_CHECKING:
    from optsim.render import CameraNoise


@dataclass(frozen=True)
class TruthFacts:
    """What a report says of the truth.

    Parameters
    ----------
    name, variation : str
        Scene and variation, or ``footage`` and the name of its files.
    description : str
        A sentence or two.
    white_w_m2_sr : float
        Declared white, W m^-2 sr^-1.
    """

    name: str
    variation: str
    description: str
    white_w_m2_sr: float


def render_truth(
    experiment: Experiment, *, backend: str | None = None, progress: Progress = silent
) -> RadianceVideo:
    """Render the HDR high-speed radiance of an experiment's scene, or import its footage, through the cache.

    Parameters
    ----------
    experiment : Experiment
        Its scene or footage, render settings, field of view and timing decide the truth; codes don't.
    backend : str, optional
        Mitsuba variant to use instead of the one chosen by probing; None for footage.
    progress : Progress
        Told of each finished pose or slot.

    Returns
    -------
    RadianceVideo
        Lazy: poses stay in the cache until a segment is asked for.

    Raises
    ------
    BackendError
        When no renderer backend works.
    ConfigError, ValueCheckError, StorageError
        When the footage is not what was stated of it.
    """
    recorded = chosen_footage(experiment)
    if recorded is not None:
        return recorded.radiance(Cache(), progress)
    from optsim import render

    return render.render_truth(
        chosen_scene(experiment),
        experiment.camera.view,
        experiment.timing,
        experiment.render,
        cache=Cache(),
        noise=camera_noise(experiment),
        backend=backend,
        progress=progress,
    )


def camera_noise(experiment: Experiment) -> CameraNoise | None:
    """Noise of the camera in a slot and a fine sample, for ``render.noise_share``; None where that is unset.

    Without neutral density, which the light rule chooses from the truth: so sampling never stops too early.
    """
    from optsim.render import CameraNoise

    if experiment.render.noise_share is None:
        return None
    camera = experiment.camera.with_nd(1.0)
    per_pixel = next(row.value for row in camera.ledger(1.0) if row.stage == "electrons a slot")
    pixels = (camera.ratio / camera.view.samples_per_pitch) ** 2
    return CameraNoise(per_pixel * pixels, camera.sensor.read_noise_e * math.sqrt(pixels))


def illumination(experiment: Experiment) -> Illumination:
    """Find what a probe of an experiment's camera is told of the light, without rendering."""
    white_w_m2_sr = describe_truth(experiment).white_w_m2_sr
    view = experiment.camera.view
    if experiment.scene is not None:
        bright = brightest_light(chosen_scene(experiment), view.tan_half_width, view.rows / view.cols)
    else:
        # Of a recording it is known how bright it can get, not how much of it does.
        footage = cast("Source", experiment.source).footage
        bright = BrightLight(footage.scale_w_m2_sr / footage.white_w_m2_sr / WHITE_OVER_INTERIOR, 0.1)
    return Illumination(white_w_m2_sr, experiment.light.percentile, experiment.light.saturation_share, bright)


def chosen_scene(experiment: Experiment) -> Scene:
    """Load the scene of an experiment in the band that it sees.

    Raises
    ------
    ConfigError
        When the truth is footage, which has no objects, depth or flow to render, or for an unknown band.
    """
    whole = whole_scene(experiment)
    return whole.in_band(experiment.scene.band if experiment.scene else None)


def whole_scene(experiment: Experiment) -> Scene:
    """Load the scene of an experiment with all its bands.

    Raises
    ------
    ConfigError
        When the truth is footage.
    """
    if experiment.scene is None:
        raise ConfigError(
            f"scene: {experiment.name} takes its truth from source.footage, which cannot be rendered; name "
            "an experiment that has a [scene]"
        )
    return load_scene(experiment.scene.name, experiment.scene.variation)


def band_nm(experiment: Experiment) -> float:
    """Wavelength of the band that an experiment sees, nm; 550 unless its scene says otherwise."""
    if experiment.scene is None:
        return MONO_NM
    bands = chosen_scene(experiment).bands
    return bands[0].wavelength_nm if bands else MONO_NM


def chosen_footage(experiment: Experiment) -> FootageTruth | None:
    """Open the footage of an experiment, None when it has a scene."""
    if experiment.source is None:
        return None
    return open_footage(experiment.source.footage, experiment.camera.view, experiment.timing)


def check_truth(experiment: Experiment) -> None:
    """Find what would stop rendering or importing before it starts: unknown names, missing files, sizes."""
    recorded = chosen_footage(experiment)
    if recorded is None:
        chosen_scene(experiment)
    else:
        recorded.check()


def describe_truth(experiment: Experiment, cache: Cache | None = None) -> TruthFacts:
    """Say what the truth is; with the cache of an import also what the recording lost to clipping."""
    recorded = chosen_footage(experiment)
    if recorded is None:
        scene = chosen_scene(experiment)
        said = scene.description
        if scene.bands:
            said += f"; in its band {scene.bands[0].name} at {scene.bands[0].wavelength_nm:g} nm"
        return TruthFacts(scene.name, scene.variation, said, scene.white_w_m2_sr)
    files = Path(recorded.source.path).name
    return TruthFacts("footage", files, recorded.description(cache), recorded.source.white_w_m2_sr)


def renderer(experiment: Experiment, backend: str | None = None) -> tuple[str, str]:
    """Mitsuba variant that renders an experiment's truth, and why; ``none`` for footage.

    Raises
    ------
    BackendError
        When no renderer backend works.
    ConfigError
        When a backend is asked for and nothing is to be rendered.
    """
    if experiment.source is None:
        from optsim import render

        chosen = render.choose_backend(backend)
        return chosen.variant, chosen.reason
    if backend is not None:
        raise ConfigError(
            f"--backend: got {backend!r}, but this truth is footage and nothing is rendered; drop it"
        )
    return "none", "the truth is recorded footage"
