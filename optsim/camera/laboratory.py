"""The virtual laboratory: takes the images of a calibration bench with a simulated camera.

All images have the camera's true parameters and its photon noise. The source for flats is an integrating
sphere that fills the field. Its radiance and the f-number are known, hence the nominal irradiance on the
modulator. A second source is a pulsed LED, synchronised to the panel. It lights a strip down the middle of
the modulator for a tenth of a slot or a whole one. So the panel is sampled within a slot, although the
shutter opens for whole frames only.

Unlike a real bench it has no error of the source's scale or uniformity, no drift, no dust, and no vibration
between frames. Its irradiance scale is exact. One number is given to it because it cannot be measured: the
retardance of white. It comes from the data sheet (``modulator.stated_half_wave_m``), which may be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.random import Generator

from optsim.calibration import Bench, Flat, Patches, Step
from optsim.calibration.orientation import UPRIGHT
from optsim.camera.camera import CodedCamera
from optsim.core.errors import ConfigError
from optsim.core.quantities import (
    Block,
    Bytes,
    ExposureCode,
    Floats,
    IrradianceVideo,
    RadianceVideo,
    Segment,
    Words,
)
from optsim.optics.panel import settled_panel

# Signal of a fully lit pixel, as a share of full well or converter range, whichever is less. Interline CCDs
# bend above half of it. Off frames get ten times the light of the brightest flat; dots and greys get the same
# as it.
_FLAT_SHARES = (0.15, 0.3, 0.45)
_FLASH_SHARE = 0.45
_SATURATED_SHARE = 4.0
_OFF_BOOST = 10.0
_GREYS = (96, 160, 208)
_DOT_SPACING = 10
_FLASHES_PER_SLOT = 10
_STEP_SLOTS = 4
_FIELDS, _FIELD_LEVEL = 6, 128
_STRIP_PX = 16
_LEAST_GLARE_PX = 24
LEAST_PANEL_PX = 24
"""Panel pixels each way below which the dots are too few for a map."""


@dataclass(frozen=True)
class Frames:
    """How many images of each setting the laboratory takes; ``patches`` are the anchors and dots."""

    darks: int
    flats: int
    off: int
    greys: int
    saturated: int
    patches: int
    glare: int
    # Of the flash, in flash lengths, from half a slot before the step to two slots after.
    delays: Sequence[int]


ALL_FRAMES = Frames(16, 8, 4, 2, 4, 2, 8, range(-5, 20))
FEW_FRAMES = Frames(6, 2, 2, 1, 2, 1, 2, (-5, -2, 0, 1, 2, 4, 7, 11, 16))
"""Sixty images: what an operator has time for at the full frame."""

Group = Flat | Patches | Step
PlannedShot = tuple[str, Callable[[], Group]]
"""Set of the bench that a group of images belongs to, and what takes them."""


def measure_bench(camera: CodedCamera, rng: Generator, frames: Frames = ALL_FRAMES) -> Bench:
    """Take all images that a camera's calibration needs.

    Parameters
    ----------
    camera : CodedCamera
        The camera, with its true parameters; at least LEAST_PANEL_PX panel pixels each way.
    rng : Generator
        Generator of all shot and read noise on the bench.
    frames : Frames
        How many images.

    Returns
    -------
    Bench
        Images and stated settings; no true parameter is in it.
    """
    taken: dict[str, list[Any]] = {}
    for name, take in planned_shots(camera, rng, frames):
        taken.setdefault(name, []).append(take())
    sets: dict[str, Any] = {name: tuple(taken.get(name, ())) for name in Bench.SETS}
    sets |= {name: taken[name][0] for name in ("off", "saturated")}
    return Bench(**bench_settings(camera), darks=taken["darks"][0].dn, **sets)


def bench_settings(camera: CodedCamera) -> dict[str, Any]:
    """Return what a laboratory knows of a camera without images: timing, panel, data sheet."""
    return {
        "slot_s": camera.slot_s,
        "slots_per_frame": camera.slots_per_frame,
        "coded_slots": camera.coded_slots,
        "panel_shape": (camera.panel_rows, camera.panel_cols),
        "white_rad": camera.modulator.stated_white_rad(camera.wavelength_m),
        "orientation": UPRIGHT,
        "ccd_pitch_m": camera.sensor.pitch_m,
        "ccd_per_panel_px": camera.ratio,
        "grey_curve": camera.modulator.grey_curve,
    }


def planned_shots(
    camera: CodedCamera, rng: Generator, frames: Frames = ALL_FRAMES, done: int = 0
) -> list[PlannedShot]:
    """Plan the images of a bench, in the order of taking them."""
    check_panel(camera)
    lab = _Laboratory(camera, rng, done)
    brightest = lab.irradiance(_FLAT_SHARES[-1])
    rows, cols = lab.panel
    corners = ((rows // 4, cols // 4), (rows // 4, 3 * cols // 4), (3 * rows // 4, cols // 4))
    shifts = (3, 3 + _DOT_SPACING // 2)
    half = min(rows, cols) // 2
    planned: list[PlannedShot] = []

    def plan(name: str, take: Callable[..., Group], *settings: Any) -> None:
        planned.append((name, partial(take, *settings)))

    plan("darks", lab.flat, 0, 0.0, frames.darks)
    for share in _FLAT_SHARES:
        plan("flats", lab.flat, 255, lab.irradiance(share), frames.flats)
    plan("off", lab.flat, 0, _OFF_BOOST * brightest, frames.off)
    for level in _GREYS:
        plan("greys", lab.flat, level, brightest, frames.greys)
    plan("saturated", lab.flat, 255, lab.irradiance(_SATURATED_SHARE), frames.saturated)
    for v, u in corners:
        plan("anchors", lab.patches, (v,), (u,), 3, brightest, frames.patches)
    for v in shifts:
        for u in shifts:
            lattice = range(v, rows - 3, _DOT_SPACING), range(u, cols - 3, _DOT_SPACING)
            plan("dots", lab.patches, *lattice, 1, brightest, frames.patches)
    # On a small panel no place is far enough from a patch to separate veiling glare from blur.
    for v, u in ((0, 0), (rows - half, cols - half)) if half >= _LEAST_GLARE_PX else ():
        plan("glare", lab.patches, (v,), (u,), half, brightest, frames.glare)
    for ends in ((0, 255), (255, 0)):
        for delay in frames.delays:
            plan("steps", lab.step, *ends, delay)
    for level in (_FIELD_LEVEL, 255):
        for slot in range(_FIELDS):
            plan("fields", lab.field, level, slot)
    return planned


def check_panel(camera: CodedCamera) -> None:
    """Refuse a panel on which the bench finds too few dots for its map.

    Raises
    ------
    ConfigError
        With the cure.
    """
    least = min(camera.panel_rows, camera.panel_cols)
    if least < LEAST_PANEL_PX:
        raise ConfigError(
            f"calibration = 'bench' needs at least {LEAST_PANEL_PX} panel pixels each way, got {least}; "
            "raise camera.panel_rows and camera.panel_cols, or set calibration=ideal"
        )


class _Laboratory:
    """A camera, its light sources and its noise."""

    def __init__(self, camera: CodedCamera, rng: Generator, done: int) -> None:
        self.camera, self.rng = camera, rng
        self._sphere = lru_cache(maxsize=2)(self._sphere_image)
        self.shown = done * _FIELDS  # slots before the next image: whole rounds of the panel's fields
        self.panel = (camera.panel_rows, camera.panel_cols)
        sensor = camera.sensor
        well_e = sensor.most_e
        electrons_a_slot = {row.stage: row.value for row in camera.ledger(1.0)}["electrons a slot"]
        # Any starting value works: on a bench the lamp is adjusted until the histogram is right.
        self._fills_well_w_m2_slot = well_e / electrons_a_slot * camera.irradiance_per_radiance

    def irradiance(self, share: float, slots: float | None = None) -> float:
        """Irradiance on the modulator that fills a share of the wells on axis, W m^-2."""
        return share * self._fills_well_w_m2_slot / (slots or self.camera.coded_slots)

    def flat(self, level: int, irradiance_w_m2: float, n_frames: int) -> Flat:
        """Sphere on, whole panel held at a level."""
        levels = np.full(self.panel, level, np.uint8)
        return Flat(level, irradiance_w_m2, self._held(levels, irradiance_w_m2, n_frames))

    def patches(
        self,
        rows: Sequence[int],
        cols: Sequence[int],
        size: int,
        irradiance_w_m2: float,
        n_frames: int,
    ) -> Patches:
        """Sphere on, bright patches held on black."""
        levels = np.zeros(self.panel, np.uint8)
        for row in range(size):
            for col in range(size):
                levels[np.ix_(np.add(rows, row), np.add(cols, col))] = 255
        dn = self._held(levels, irradiance_w_m2, n_frames)
        return Patches(tuple(rows), tuple(cols), size, irradiance_w_m2, dn)

    def _held(self, levels: Bytes, irradiance_w_m2: float, n_frames: int) -> Words:
        return self._take(self.camera, self._sphere(irradiance_w_m2), levels, levels, n_frames)

    def _sphere_image(self, irradiance_w_m2: float) -> IrradianceVideo:
        """Image of the sphere on the modulator: the same for all panels that it lights alike."""
        camera = self.camera
        view, n = camera.view, camera.slots_per_frame
        radiance = np.full(
            (view.rows, view.cols), irradiance_w_m2 / camera.irradiance_per_radiance, np.float32
        )
        sphere = RadianceVideo.on_view(
            view, camera.slot_s, lambda _: Segment(radiance, radiance, (), n), slots_per_segment=n, n_slots=n
        )
        return camera.form_image(sphere)

    def step(self, before: int, after: int, delay: int) -> Step:
        """LED flash, ``delay`` flash lengths after the panel changes from one held level to another."""
        # The shutter is open for four slots around the flash; the panel changes at the start of the second.
        slot, instant = divmod(_FLASHES_PER_SLOT + delay, _FLASHES_PER_SLOT)
        pulse = np.zeros(_FLASHES_PER_SLOT, np.float32)
        pulse[instant] = self.irradiance(_FLASH_SHARE, 1 / _FLASHES_PER_SLOT)
        flash_s = self.camera.slot_s / _FLASHES_PER_SLOT
        return Step(
            before, after, delay * flash_s, flash_s, self._flashed(before, after, pulse, slot, _STEP_SLOTS)
        )

    def field(self, level: int, slot: int) -> Step:
        """LED on for one whole slot, counted from 0, with the panel held at a level."""
        pulse = np.full(1, self.irradiance(_FLASH_SHARE, 1), np.float32)
        slot_s = self.camera.slot_s
        return Step(level, level, slot * slot_s, slot_s, self._flashed(level, level, pulse, slot, _FIELDS))

    def _flashed(self, before: int, after: int, pulse: Floats, slot: int, n_slots: int) -> Words:
        """Take a frame of some slots; in one of them the LED's light is ``pulse``, instant by instant."""
        camera = self.camera.model_copy(update={"slots_per_frame": n_slots, "overlap": True})
        view = camera.view
        width = min(_STRIP_PX * view.samples_per_pitch, view.cols)
        strip = np.broadcast_to(pulse[:, None, None], (len(pulse), view.rows, width))
        black = np.zeros((view.rows, view.cols), np.float32)
        flash = Block(0, (view.cols - width) // 2, np.ascontiguousarray(strip))
        led = IrradianceVideo.on_view(
            view,
            camera.slot_s,
            lambda index: Segment(black, black, (flash,) if index == slot else (), len(pulse)),
            slots_per_segment=1,
            n_slots=n_slots,
            instants_per_slot=len(pulse),
        )
        first, second = (np.full(self.panel, level, np.uint8) for level in (before, after))
        return self._take(camera, led, first, second, 1)

    def _take(
        self, camera: CodedCamera, light: IrradianceVideo, first: Bytes, then: Bytes, n_frames: int
    ) -> Words:
        """Take frames of a panel held at ``first`` until the second slot begins, then at ``then``."""
        levels = np.repeat(then[None], camera.slots_per_frame, axis=0)
        levels[0] = first
        code = ExposureCode(levels, np.zeros(self.panel, np.bool_))
        # Each image has its own delay by the panel's jitter.
        held = replace(settled_panel(first, camera.panel_response), slots_displayed=self.shown)
        self.shown += _FIELDS
        expected_e, _ = camera.expected_electrons(light, 0, code, held)
        frames = [
            camera.sensor.digitise(expected_e, camera.exposure_s, camera.serial_number, self.rng)[0]
            for _ in range(n_frames)
        ]
        return np.stack(frames)
