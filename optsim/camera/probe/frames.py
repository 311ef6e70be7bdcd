"""Size of a change of the camera in a probe's frame.

It is the rms change of a frame relative to the rms of its predicted noise, over pixels that don't saturate.
Added noise counts in squares. Effects that a calibration removes, such as shading, count in full. There is a
frame for each scheme, and the largest size counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.camera.effects import Changes, changed
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.camera.probe.made_code import Schemes, made_code
from optsim.core.quantities import Bools, Doubles, Floats, RadianceVideo

T = TypeVar("T")

NOTHING: Changes = {}
# Plain probes only mix the weights at pixel edges, keep PSFs constant over the field, and put the PSF tails
# of movers on straight lines in time. This saves most of their time. It changes other sizes by at most a
# sixth for the nominal camera (the sensor's bend by a quarter), and a third for a pessimistic one. Effects
# that concern these are compared with a model that has them.
PLAIN: Changes = {
    "modulator": {"fringe_model": "mixed"},
    "objective": {"field_error": 1.0, "moving_tail_share": MOVING_TAIL_SHARE},
    "relay": {"field_error": 1.0},
}
FINEST_FIELD = 5e-3  # of a point's light is misplaced
# Where an effect includes fringe fields, as a run has them.
_RIMS: Changes = {"modulator": {"fringe_model": "coarse"}}
_OBJECTIVE: Changes = {"objective": {"field_error": FINEST_FIELD}}
_RELAY: Changes = {"relay": {"field_error": FINEST_FIELD}}
_WHOLE: dict[str, Changes] = {
    "fringing": _RIMS,
    "response": _RIMS,
    "fields": _RIMS,
    "objective_blur": _OBJECTIVE,
    "relay_blur": _RELAY,
}
MARGIN_PX = 4
"""CCD pixels around a small panel's image: the largest displacement of its pixels."""


def compared_with(name: str) -> Changes:
    """Return the baseline of an effect: nothing, or the model parts that a plain probe lacks."""
    return _WHOLE.get(name, NOTHING)


@dataclass(frozen=True, eq=False)
class Probe:
    """A small camera and its scene.

    Parameters
    ----------
    camera : CodedCamera
        Small camera, with the neutral density of the light rule.
    radiance : RadianceVideo
        The scene.
    schemes : mapping
        Schemes that give the codes: name -> scheme.
    lamp_px : float
        Panel pixels that the brightest light covers on the large camera that the probe stands for.
    mapping : Changes
        Changes that displace the pixels of the probe's image as far as those of the large camera.
    """

    camera: CodedCamera
    radiance: RadianceVideo
    schemes: Schemes
    lamp_px: float
    mapping: Changes = field(default_factory=dict[str, dict[str, float]])

    # Most changes keep most inputs of a frame: they are cached.
    @cached_property
    def _made(self) -> dict[object, Any]:
        return {}

    def _once(self, key: object, make: Callable[[], T]) -> T:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    def frame(self, changes: Changes, scheme: str) -> tuple[Doubles, Bools]:
        """Noise-free signal of a camera with changed parts, electrons, and the pixels that do not clip."""
        camera = changed(self.camera, changes)
        expected = camera.electrons_of(self._image(camera, scheme))
        edges = (min(2 * MARGIN_PX, (n - 1) // 2) for n in expected.shape)
        inner = tuple(slice(edge, n - edge) for edge, n in zip(edges, expected.shape, strict=True))
        signal = camera.sensor.signal_e(expected, camera.exposure_s, camera.serial_number)
        return signal[inner], (expected < camera.sensor.most_e)[inner]

    def _image(self, camera: CodedCamera, scheme: str) -> Doubles:
        """Radiant exposure of the CCD."""
        lens, relay = _image_of(camera, "objective"), _image_of(camera, "relay")
        parts = camera.modulator.model_dump_json(), camera.splitter.model_dump_json()
        opening, gain = self._once(
            ("gate", *parts, camera.objective.working_f_number, camera.coded_slots), lambda: _gate(camera)
        )
        opened = scheme, opening
        behind = lens, opened, gain

        def energy() -> Floats:
            light = self._once(("light", lens), lambda: camera.form_image(self.radiance))
            code = partial(made_code, self.schemes[scheme], camera, self.radiance, self.lamp_px)
            shutter = self._once(("shutter", opened), lambda: camera.shutter(code(), None, 1)[0])
            return camera.panel_energy(light, 0, shutter)

        def image() -> Doubles:
            return camera.relay_operator().apply(self._once(("energy", behind), energy))

        return self._once(("image", behind, relay, camera.relay_geometry()), image)

    def change_e(self, changes: Changes, of: Changes, scheme: str) -> float:
        """Rms difference between a frame with ``changes`` on top of ``of`` and one with ``of``, electrons.

        Infinite where every pixel clips in either frame.
        """
        more = {part: {**of.get(part, {}), **changes.get(part, {})} for part in of.keys() | changes.keys()}
        whole, usable = self._whole(of, scheme)
        without, unclipped = self.frame(more, scheme)
        both = usable & unclipped
        if not both.any():
            return float("inf")
        dark, less = (changed(self.camera, each).sensor.dark_noise_e ** 2 for each in (of, more))
        return float(np.sqrt(np.mean((whole - without)[both] ** 2) + abs(dark - less)))

    def sizes(self, changes: Changes, of: Changes = NOTHING) -> Iterator[tuple[float, str]]:
        """Rms difference between frames with ``changes`` on top of ``of`` and with ``of``, over the noise.

        One for each scheme, with its name. Infinite where every pixel clips in either frame.
        """
        for scheme, (noise_e, _) in self.noise_e.items():
            yield self.change_e(changes, of, scheme) / noise_e, scheme

    @cached_property
    def noise_e(self) -> dict[str, tuple[float, float]]:
        """Rms noise of a frame by its scheme, electrons: all of it, and the shot noise alone.

        For a frame without pixels, or with all of them clipped, it is the noise in the dark.
        """
        return {scheme: self._noise_e(scheme) for scheme in self.schemes}

    def _noise_e(self, scheme: str) -> tuple[float, float]:
        whole, usable = self._whole(NOTHING, scheme)
        light = float(np.mean(whole[usable])) if usable.any() else 0.0
        return (light + self.camera.sensor.dark_noise_e**2) ** 0.5, light**0.5

    def _whole(self, changes: Changes, scheme: str) -> tuple[Doubles, Bools]:
        return self._once(("frame", repr(changes), scheme), lambda: self.frame(changes, scheme))


def cone_and_sample(camera: CodedCamera, part: str) -> tuple[float, float]:
    """f-number and side of a fine sample, m, in the image of objective or relay."""
    f_number, sample_m = camera.objective.working_f_number, camera.modulator.pitch_m / SAMPLES_PER_PITCH
    if part == "relay":
        return camera.relay.image_f_number(f_number), sample_m * camera.relay.magnification
    return f_number, sample_m


def _gate(camera: CodedCamera) -> tuple[object, bytes]:
    """Key of the inputs that decide the panel's exposure times and transmission."""
    opening = camera.modulator.model_dump_json(), camera.column_leaks.tobytes(), camera.coded_slots
    return opening, camera.panel_gain.tobytes()


def _image_of(camera: CodedCamera, part: str) -> tuple[str, int]:
    """Key of the image of objective or relay; field errors with the same number of nodes share one."""
    lens, view = getattr(camera, part), camera.view
    grid = *cone_and_sample(camera, part), (view.rows, view.cols)
    defocus_m = camera.relay.ccd_defocus_m(*grid, SAMPLES_PER_PITCH) if part == "relay" else 0.0
    psf = lens.psf(*grid, defocus_m, camera.wavelength_m)
    return lens.model_dump_json(exclude={"field_error"}), len(psf.cores)
