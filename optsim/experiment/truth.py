"""The truth of an experiment: a scene, rendered through the cache, or recorded footage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from optsim.camera.probe import WHITE_OVER_INTERIOR, Illumination
from optsim.camera.skip import Given
from optsim.core.cache import Cache
from optsim.core.errors import BackendError, ConfigError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import RadianceVideo, View
from optsim.experiment.experiment import Experiment, Source
from optsim.experiment.focus import Focus, focus_on, seen_through
from optsim.footage import FootageTruth, open_footage
from optsim.scene import BrightLight, Scene, bright_lights, load_scene

if TYPE_CHECKING:
    from optsim.render import CameraNoise


@dataclass(frozen=True)
class TruthFacts:
    """Facts on the truth for a report."""

    name: str  # Scene, or "footage" with the name of its files as variation.
    variation: str
    description: str  # A sentence or two.
    white_w_m2_sr: float  # Declared white.
    focus: Focus | None  # Effect of the lens; None for footage, which already includes a lens.


@dataclass(frozen=True)
class SceneLight:
    """Decision for polarised or unpolarised rendering of a scene, and its reason."""

    # Of the transmitted polarised component, counted twice; None for unpolarised light.
    azimuth_rad: float | None
    why: str  # One line for people.


def scene_light(experiment: Experiment, *, preview: bool = False) -> SceneLight:
    """Decide whether a scene is rendered with its polarisation, by ``camera.splitter.scene_light``."""
    splitter = experiment.camera.splitter
    if experiment.scene is None:
        return SceneLight(None, "unpolarised: of a recording nothing else is known")
    if splitter.scene_light == "unpolarised":
        return SceneLight(None, "unpolarised, as camera.splitter.scene_light says")
    found = chosen_scene(experiment).polarising()
    if splitter.scene_light == "auto" and not found:
        return SceneLight(None, "unpolarised: no material of the scene polarises")
    if preview and splitter.scene_light == "auto":
        return SceneLight(
            None, f"TAKEN AS UNPOLARISED, though {', '.join(found)} polarise: the scalar renderer cannot"
        )
    if preview:
        raise BackendError(
            "camera.splitter.scene_light: got 'polarised', but only the scalar renderer works here, which "
            "has no polarised light; cure: 'optsim doctor', or set it to 'auto' or 'unpolarised'"
        )
    why = (
        f"by {', '.join(found)}" if found else "as camera.splitter.scene_light says, though nothing polarises"
    )
    return SceneLight(
        splitter.azimuth_rad,
        f"polarised {why}: twice the component at "
        f"{math.degrees(splitter.azimuth_rad):g} degrees from the picture's rows",
    )


def render_truth(
    experiment: Experiment,
    *,
    backend: str | None = None,
    slot_error: float | None = None,
    progress: Progress = silent,
) -> RadianceVideo:
    """Render the HDR high-speed radiance of an experiment's scene, or import its footage, through the cache.

    Parameters
    ----------
    experiment : Experiment
        Its scene or footage, render settings, field of view and timing determine the truth; codes don't.
    backend : str, optional
        Mitsuba variant to use instead of the one chosen by probing; None for footage.
    slot_error : float, optional
        For a scene: render each slot on demand, with its own noise and this error.
    progress : Progress
        Called after each finished pose or slot.

    Returns
    -------
    RadianceVideo
        Lazy: poses stay in the cache until a segment is needed. For polarised light it is twice the
        component that the splitter transmits, see :func:`scene_light`.

    Raises
    ------
    BackendError
        When no renderer backend works.
    ConfigError, ValueCheckError, StorageError
        When the footage differs from its description.
    """
    recorded = chosen_footage(experiment)
    if recorded is not None:
        return recorded.radiance(Cache(), progress)
    from optsim import render

    light = scene_light(experiment, preview=render.choose_backend(backend).preview)
    return render.render_truth(
        chosen_scene(experiment),
        truth_view(experiment),
        experiment.timing,
        experiment.render,
        cache=Cache(),
        noise=camera_noise(experiment),
        backend=backend,
        azimuth_rad=light.azimuth_rad,
        slot_error=slot_error,
        progress=progress,
    )


def scene_focus(experiment: Experiment) -> Focus:
    """Effect of the objective's focus and distortion on an experiment's scene, without rendering."""
    timing = experiment.timing
    duration_s = timing.n_slots * timing.slot_s
    return focus_on(chosen_scene(experiment), experiment.camera, duration_s, experiment.tolerance)


def truth_view(experiment: Experiment) -> View:
    """Return the view for rendering an experiment's scene: a pinhole where defocus would be invisible."""
    return seen_through(experiment.camera.view, scene_focus(experiment))


def camera_noise(experiment: Experiment) -> CameraNoise | None:
    """Noise of the camera in a slot and fine sample, for ``render.noise_share``; None where that is unset."""
    from optsim.render import CameraNoise

    if experiment.render.noise_share is None:
        return None
    # The light rule sets the density from the truth: without it, sampling never stops too early.
    camera = experiment.camera.with_nd(1.0)
    per_pixel = next(row.value for row in camera.ledger(1.0) if row.stage == "electrons a slot")
    pixels = (camera.ratio / camera.view.samples_per_pitch) ** 2
    return CameraNoise(per_pixel * pixels, camera.sensor.read_noise_e * math.sqrt(pixels))


def illumination(experiment: Experiment) -> Illumination:
    """Return the light for a probe of an experiment's camera, without rendering."""
    view = experiment.camera.view
    if experiment.scene is not None:
        scene = chosen_scene(experiment)
        white_w_m2_sr = scene.white_w_m2_sr
        lights = bright_lights(scene, view.tan_half_width, view.rows / view.cols)
    else:
        # A recording's maximum is known, but not the share of bright light.
        footage = cast("Source", experiment.source).footage
        white_w_m2_sr = footage.white_w_m2_sr
        lights = [BrightLight(footage.scale_w_m2_sr / footage.white_w_m2_sr / WHITE_OVER_INTERIOR, 0.1)]
    light = experiment.light
    return Illumination(white_w_m2_sr, light.percentile, light.saturation_share, tuple(lights))


def given(experiment: Experiment) -> Given:
    """Collect the inputs of an experiment's plan, without rendering."""
    light = illumination(experiment)
    if experiment.scene is None:
        return Given(experiment.camera, light)
    scene, focus = chosen_scene(experiment), describe_truth(experiment).focus
    return Given(
        experiment.camera,
        light,
        change=scene.kind_of_change(),
        flickers=any(lamp.lit and lamp.flicker for lamp in scene.lamps.values()),
        polarised=scene_light(experiment).azimuth_rad is not None,
        focused=focus is not None and focus.choice != "modelled",
    )


def chosen_scene(experiment: Experiment) -> Scene:
    """Load the scene of an experiment in its band.

    Raises
    ------
    ConfigError
        When the truth is footage, which has no objects, depth or flow to render; for an unknown band; or
        when the camera works at another wavelength.
    """
    whole, camera = whole_scene(experiment), experiment.camera
    scene = whole.in_band(experiment.scene.band if experiment.scene else None)
    if scene.bands and scene.bands[0].wavelength_m != camera.wavelength_m:
        raise ConfigError(
            f"camera.wavelength_m: got {camera.wavelength_nm:g} nm, expected the scene's band "
            f"{scene.bands[0].name!r} at {scene.bands[0].wavelength_nm:g} nm; load the experiment with this "
            "scene.band"
        )
    return scene


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


def chosen_footage(experiment: Experiment) -> FootageTruth | None:
    """Open the footage of an experiment, None when it has a scene."""
    if experiment.source is None:
        return None
    return open_footage(experiment.source.footage, experiment.camera.view, experiment.timing)


def check_truth(experiment: Experiment) -> None:
    """Check for obstacles to rendering or importing: unknown names, missing files, sizes."""
    recorded = chosen_footage(experiment)
    if recorded is None:
        chosen_scene(experiment)
    else:
        recorded.check()


def describe_truth(experiment: Experiment, cache: Cache | None = None) -> TruthFacts:
    """Describe the truth; with the cache of an import also the loss of the recording to clipping."""
    recorded = chosen_footage(experiment)
    if recorded is None:
        scene = chosen_scene(experiment)
        focus = scene_focus(experiment)
        said = f"{scene.description}; {focus.text()}"
        if scene.bands:
            said += f"; in its band {scene.bands[0].name} at {scene.bands[0].wavelength_nm:g} nm"
        return TruthFacts(scene.name, scene.variation, said, scene.white_w_m2_sr, focus)
    files = Path(recorded.source.path).name
    said = (
        f"{recorded.description(cache)}; its focus and distortion are those of the lens that it was taken by"
    )
    return TruthFacts("footage", files, said, recorded.source.white_w_m2_sr, None)


def truth_content(experiment: Experiment) -> object:
    """Return the content of the truth for a hash: the loaded scene, or the content of a recording's files."""
    recorded = chosen_footage(experiment)
    return chosen_scene(experiment).model_dump(mode="json") if recorded is None else recorded.keys()


def renderer(experiment: Experiment, backend: str | None = None) -> tuple[str, str]:
    """Return the Mitsuba variant that renders an experiment's truth, and why; ``none`` for footage.

    Raises
    ------
    BackendError
        When no renderer backend works, or none that the scene's light needs.
    ConfigError
        When a backend is requested and nothing is to be rendered.
    """
    if experiment.source is None:
        from optsim import render

        chosen = render.choose_backend(backend)
        scene_light(experiment, preview=chosen.preview)
        return chosen.variant, chosen.reason
    if backend is not None:
        raise ConfigError(
            f"--backend: got {backend!r}, but this truth is footage and nothing is rendered; drop it"
        )
    return "none", "the truth is recorded footage"
