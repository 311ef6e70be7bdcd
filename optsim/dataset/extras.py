"""Optional channels of an export: light by groups of lamps, Stokes vector, denoised radiance."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from optsim.core.config import Part, build
from optsim.core.errors import BackendError, ConfigError
from optsim.core.quantities import Floats, Passes
from optsim.dataset.slot_light import SlotLight, bright_during, named_groups
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import chosen_scene, truth_view, whole_scene
from optsim.scene import Scene

# Default samples of a fine sample and slot: noise of about a fifth in window_room. No source.
LIGHT_SAMPLES = 64
STOKES_SAMPLES = 64
BAND_SAMPLES = 64

Record = dict[str, Any]
_UNIT = "W m^-2 sr^-1"
_MEANS_LIGHT = (
    "Y.light.<group>: radiance that a group of lamps gives in this slot, as bright as it is then (gain), "
    "with all others dark; mean over the slot. Rendered directly, with Monte-Carlo noise of its own and the "
    "same random numbers for each group: the sum of the groups is an estimate of Y, not Y itself"
)
_MEANS_BANDS = (
    "Y.band.<band>: radiance in each spectral band of the scene, mean over the slot. Rendered directly, with "
    "Monte-Carlo noise of its own and the same random numbers for each band, so that noise has little "
    "colour; Y is another estimate of the band that is seen"
)
_MEANS_STOKES = (
    "S0 .. S3: Stokes radiance at the middle of the slot, times_s[1] (Y is the mean over the slot), lamps as "
    "bright as on the mean over the slot; rendered with polarised light and Monte-Carlo noise of its own, so "
    "S0 is no copy of Y"
)
# As in optsim.render.stokes, whose tests check them.
_SIGNS = {
    "S1": "> 0: the field swings along the picture's rows, horizontally; a level floor's gloss has S1 > 0",
    "S2": "> 0: along the diagonal from the lower left to the upper right",
    "S3": "> 0: the field at one place turns clockwise as seen against the light (right circular)",
    "frame": "the sample's own: x is perpendicular to its ray and to the camera's vertical",
    "source": "R. A. Chipman, W.-S. T. Lam and G. Young, Polarized Light and Optical Systems, 2018, ch. 3",
}
_MEANS_DENOISED = (
    "Y.denoised: Y denoised with albedo and N; biased, never for accuracy figures; Y is the raw radiance"
)


class Extras(Part):
    """Channels of an export besides the usual ones; sample counts are for a fine sample and slot.

    Parameters
    ----------
    light_samples : int, optional
        One channel ``Y.light.<group>`` for each group of lamps with the same flicker; samples of each.
    stokes_samples : int, optional
        Channels ``S0`` .. ``S3``; samples of each.
    band_samples : int
        Samples of one channel ``Y.band.<band>`` for each band of a scene that has several.
    denoise : bool
        A channel ``Y.denoised`` beside Y, for viewing.
    """

    light_samples: int | None = Field(default=None, ge=1, le=1 << 20)
    stokes_samples: int | None = Field(default=None, ge=1, le=1 << 20)
    band_samples: int = Field(default=BAND_SAMPLES, ge=1, le=1 << 20)
    denoise: bool = False

    def check(self, backend: str | None = None) -> None:
        """Check for obstacles to an export, before anything is rendered.

        Raises
        ------
        ConfigError
            When denoising is requested and its extra is not installed.
        BackendError
            When polarised light is requested and only the scalar fallback works.
        """
        from optsim import render

        if self.denoise:
            from optsim.render.denoise import denoiser

            denoiser()
        report = render.choose_backend(backend)
        if self.stokes_samples and report.preview:
            raise BackendError(
                f"--stokes: polarised light needs llvm_ad_mono or cuda_ad_mono, but only {report.variant} "
                f"works here: {report.reason}; cure: leave --stokes out"
            )


def choose_extras(
    experiment: Experiment,
    samples: int | None = None,
    *,
    light_groups: bool = False,
    stokes: bool = False,
    denoise: bool = False,
) -> Extras:
    """Choose extras for the command line: one number of samples for all, or the defaults.

    Raises
    ------
    ConfigError
        For samples where nothing is sampled, or less than one.
    """
    bands = len(whole_scene(experiment).bands) > 1
    if samples is not None and not (light_groups or stokes or bands):
        raise ConfigError(
            f"--samples: got {samples}, but nothing asked for takes samples; cure: add --light-groups or "
            "--stokes, or a scene with several bands, or drop it"
        )

    def chosen(default: int) -> int:
        return default if samples is None else samples

    table = {
        "light_samples": chosen(LIGHT_SAMPLES) if light_groups else None,
        "stokes_samples": chosen(STOKES_SAMPLES) if stokes else None,
        "band_samples": chosen(BAND_SAMPLES) if bands else BAND_SAMPLES,
        "denoise": denoise,
    }
    return build(Extras, table, where="--samples")


def channel_names(extras: Extras, scene: Scene) -> tuple[str, ...]:
    """Names of the extra channels of the export of a scene with all its bands."""
    bands = [f"Y.band.{band.name}" for band in scene.bands] if len(scene.bands) > 1 else []
    light = [f"Y.light.{name}" for name in named_groups(scene)] if extras.light_samples else []
    stokes = [f"S{i}" for i in range(4)] if extras.stokes_samples else []
    return (*bands, *light, *stokes, *(["Y.denoised"] if extras.denoise else []))


class ExtraChannels:
    """Renderer of the extra channels of many slots.

    Parameters
    ----------
    extras : Extras
        The channels.
    experiment : Experiment
        Scene, view, slots, and render settings.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    """

    def __init__(self, extras: Extras, experiment: Experiment, *, backend: str | None = None) -> None:
        self._extras, self._experiment, self._backend = extras, experiment, backend
        self._scene, whole, light = chosen_scene(experiment), whole_scene(experiment), extras.light_samples
        self._light = SlotLight(self._scene, experiment, light) if light else None
        self._wavelengths = {band.name: band.wavelength_nm for band in whole.bands}
        self._bands = {
            band: SlotLight(whole.in_band(band), experiment, extras.band_samples)
            for band in (self._wavelengths if len(self._wavelengths) > 1 else ())
        }

    def of(self, slot: int, passes: Passes, radiance: Floats) -> tuple[dict[str, Floats], Record]:
        """Render the extra channels of a slot.

        Parameters
        ----------
        slot : int
            Index of the slot.
        passes : Passes
            Passes of the middle of the slot.
        radiance : ndarray of shape (y, x), float32
            Mean over the slot, W m^-2 sr^-1.

        Returns
        -------
        channels : dict
            Name -> array of shape (y, x), float32.
        attributes : dict
            Their meaning, with units, samples and signs.
        """
        channels: dict[str, Floats] = {}
        said: Record = {}
        for found, meaning in (
            self._by_band(slot),
            self._by_group(slot),
            self._stokes(slot),
            self._denoised(passes, radiance),
        ):
            channels |= found
            said |= meaning
        return channels, said

    def _by_band(self, slot: int) -> tuple[dict[str, Floats], Record]:
        if not self._bands:
            return {}, {}
        channels = {
            f"Y.band.{band}": np.asarray(sum(light.of(slot).values()), np.float32)
            for band, light in self._bands.items()
        }
        said = {
            "unit": _UNIT,
            "meaning": _MEANS_BANDS,
            "samples": {band: light.samples(slot) for band, light in self._bands.items()},
            "wavelength_nm": self._wavelengths,
            "seen": self._scene.bands[0].name,
        }
        return channels, {"Y.band": said}

    def _by_group(self, slot: int) -> tuple[dict[str, Floats], Record]:
        if self._light is None:
            return {}, {}
        light, instants = self._light, self._experiment.render.instants_per_slot
        groups = {
            name: {
                "lamps": list(lamps),
                "flicker": key,
                "gain": sum(light.gains(name, slot)) / instants,
            }
            for (name, lamps), key in zip(light.groups.items(), self._scene.light_groups(), strict=True)
        }
        said = {
            "unit": _UNIT,
            "meaning": _MEANS_LIGHT,
            "samples": light.samples(slot),
            "groups": groups,
        }
        channels = {f"Y.light.{name}": each.astype(np.float32) for name, each in light.of(slot).items()}
        return channels, {"Y.light": said}

    def _stokes(self, slot: int) -> tuple[dict[str, Floats], Record]:
        samples = self._extras.stokes_samples
        if samples is None:
            return {}, {}
        from optsim.render.plan import seed_of
        from optsim.render.stokes import render_stokes

        view, slot_s = truth_view(self._experiment), self._experiment.timing.slot_s
        seen = np.zeros((4, view.rows, view.cols), np.float32)
        if (scene := bright_during(self._scene, slot * slot_s, (slot + 1) * slot_s)) is not None:
            seed = seed_of(self._experiment.render.seed, "stokes", slot)
            time_s = (slot + 0.5) * slot_s
            seen = render_stokes(scene, view, time_s, samples, seed, backend=self._backend)
        said = {"unit": _UNIT, "meaning": _MEANS_STOKES, "samples": samples, "signs": _SIGNS}
        return {f"S{i}": seen[i] for i in range(4)}, {"S": said}

    def _denoised(self, passes: Passes, radiance: Floats) -> tuple[dict[str, Floats], Record]:
        if not self._extras.denoise:
            return {}, {}
        from optsim.render.denoise import denoised

        found = denoised(radiance, passes.albedo, passes.normal)
        said = {**found.attributes(), "meaning": _MEANS_DENOISED}
        return {"Y.denoised": found.w_m2_sr}, {"Y.denoised": said}
