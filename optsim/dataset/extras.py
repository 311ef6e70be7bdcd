"""Further channels of an export: bands and colour, groups of lamps, Stokes vector, denoised radiance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pydantic import Field

from optsim.core.config import Part, build
from optsim.core.errors import BackendError, ConfigError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats, Passes
from optsim.dataset.slot_light import SlotLight, bright_during, named_groups
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import chosen_scene, truth_view, whole_scene
from optsim.scene import Scene

# Default samples of a fine sample and slot: noise of about a fifth in window_room. No source.
LIGHT_SAMPLES = 64
STOKES_SAMPLES = 64
# They add less noise than that of the truth, at most half of it in flying_solids (bench render.colour).
BAND_SAMPLES = 2

Record = dict[str, Any]
_UNIT = "W m^-2 sr^-1"
_MEANS_LIGHT = (
    "Y.light.<group>: radiance that a group of lamps gives in this slot, as bright as it is then (gain), "
    "with all others dark; mean over the slot. Rendered directly, with Monte-Carlo noise of its own and the "
    "same random numbers for each group: the sum of the groups is an estimate of Y, not Y itself"
)
_MEANS_BANDS = (
    "radiance in each spectral band of the scene, mean over the slot; the band that is seen is Y. Each other "
    "one is a multiple of Y, by the reflectances of the first surface, and an estimate of the rest by few "
    "random paths: unbiased, so it may be slightly negative, and with noise of little colour"
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
        Samples for one channel for each band of a scene that has several: ``R``, ``G``, ``B`` of an sRGB
        scene, otherwise ``Y.band.<band>``. Movers' own pixels get four times as many.
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
    light = [f"Y.light.{name}" for name in named_groups(scene)] if extras.light_samples else []
    stokes = [f"S{i}" for i in range(4)] if extras.stokes_samples else []
    return (*band_channels(scene).values(), *light, *stokes, *(["Y.denoised"] if extras.denoise else []))


def band_channels(scene: Scene) -> dict[str, str]:
    """Channel of each band of a scene with all its bands; none of a scene with a single band."""
    colour = [band.name for band in scene.bands] == [*"RGB"] == [band.channel for band in scene.bands]
    names = [band.name for band in scene.bands] if len(scene.bands) > 1 else []
    return {name: name if colour else f"Y.band.{name}" for name in names}


class ExtraChannels:
    """Renderer of the extra channels of many slots."""

    def __init__(
        self,
        extras: Extras,
        experiment: Experiment,
        slots: Sequence[int],
        *,
        shared: bool = True,
        backend: str | None = None,
        progress: Progress = silent,
    ) -> None:
        self._extras, self._experiment, self._backend = extras, experiment, backend
        self._scene, whole, light = chosen_scene(experiment), whole_scene(experiment), extras.light_samples
        self._light = SlotLight(self._scene, experiment, light) if light else None
        self._wavelengths = {band.name: band.wavelength_nm for band in whole.bands}
        self._channels = band_channels(whole)
        self._bands = None
        if self._channels:
            from optsim.render.by_band import BandLight

            self._bands = BandLight(
                whole,
                self._scene.bands[0].name,
                truth_view(experiment),
                experiment.timing,
                experiment.render,
                slots,
                extras.band_samples,
                shared=shared,
                backend=backend,
                progress=progress,
            )

    def of(
        self, slot: int, passes: Passes, radiance: Floats, half: Floats | None
    ) -> tuple[dict[str, Floats], Record]:
        """Render the extra channels of a slot."""
        channels: dict[str, Floats] = {}
        said: Record = {}
        for found, meaning in (
            self._by_band(slot, radiance, half),
            self._by_group(slot),
            self._stokes(slot),
            self._denoised(passes, radiance),
        ):
            channels |= found
            said |= meaning
        return channels, said

    def _by_band(self, slot: int, radiance: Floats, half: Floats | None) -> tuple[dict[str, Floats], Record]:
        if self._bands is None:
            return {}, {}
        found = self._bands.of(slot, radiance, half)
        said = {
            "unit": _UNIT,
            "meaning": _MEANS_BANDS,
            "channels": self._channels,
            "wavelength_nm": self._wavelengths,
            "seen": self._scene.bands[0].name,
            "samples": self._bands.samples,
            "noise_is": "rms over the picture of the standard deviation over (radiance + 1 % of white)",
            "noise": found.noise,
            "noise_besides_Y": found.own_noise,
        }
        channels = {self._channels[band]: light for band, light in found.w_m2_sr.items()}
        return channels, {"colour" if "R" in channels else "Y.band": said}

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
