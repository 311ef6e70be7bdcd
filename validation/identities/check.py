"""Identities that any camera of this kind obeys: complementary codes, all-on, and a shift of everything."""

from __future__ import annotations

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import with_effects
from optsim.camera.hardware import demo
from optsim.core.quantities import Doubles, ExposureCode, Floats
from optsim.footage.made import footage

CLAIM = (
    "complementary codes of an instantaneous panel add to all-on plus all-off; all-on, on for long, is a "
    "plain camera; scene and code shifted by a panel pixel shift the frame by 3 CCD pixels at a ratio of 3, "
    "and shifted by 25 panel pixels by 72 at 2.88"
)
ORACLE = (
    "linearity; a rectangle clipped by CCD pixels on a piece of paper, with photon budget and incoherent "
    "Jones sums; a moved copy of the frame itself; numpy only"
)
SOURCE = (
    "superposition and shift invariance (Goodman, Introduction to Fourier Optics, 3rd ed., ch. 2); R. C. "
    "Jones, J. Opt. Soc. Am. 31(7) 488 (1941)"
)
TOLERANCE = 1e-6
REASON = (
    "Weights, energies and entries of the relay's operator are float32, 6e-8 each; PSF wings that the "
    "panel's edge cuts off differently after a shift leave 1.2e-7. Relative to the brightest pixel."
)
FILES = (
    "optsim/camera/camera.py",
    "optsim/optics/*.py",
    "optsim/camera/parts/*.py",
    "optsim/camera/hardware/*.py",
)

_ROWS, _COLS, _SLOTS, _SLOT_S = 120, 160, 4, 1 / 180
_SHARP = {"objective_blur": "ideal", "relay_blur": "ideal"}
_KEPT = {"contrast": "nominal", "objective_blur": "nominal", "relay_blur": "nominal"}


def measure() -> float:
    """Find the largest deviation of the three, relative to the brightest pixel."""
    shifts = [_shifted(3.0, 1, 3, code_way=1), _shifted(2.88, 25, 72, code_way=1)]
    return max(_complementary(slow=False), _all_on(0.0), *shifts, key=abs)


def perturbed() -> float:
    """Break each, return the least: slow crystal, half a CCD pixel off, code moved the wrong way."""
    shifts = [_shifted(3.0, 1, 3, code_way=-1), _shifted(2.88, 25, 72, code_way=-1)]
    return min(_complementary(slow=True), _all_on(0.5), *shifts, key=abs)


def _camera(ratio: float, **effects: str) -> CodedCamera:
    """Camera with PSFs that are the same everywhere, and nothing else that tells places apart."""
    camera = with_effects(demo(), {"all": "ideal", **_KEPT, **effects})
    parts = {
        "objective": camera.objective.model_copy(update={"field_error": 1.0}),
        "relay": camera.relay.model_copy(update={"field_error": 1.0, "magnification": ratio * 4.54 / 20}),
    }
    return camera.model_copy(update={**parts, "slots_per_frame": _SLOTS})


def _frame(camera: CodedCamera, light: Floats, levels: np.ndarray) -> Doubles:
    """Second of two equal frames: of a panel that has shown the code before."""
    truth = camera.form_image(footage(np.concatenate([light, light]), slot_s=_SLOT_S, samples_per_pitch=3))
    code = ExposureCode(levels, np.zeros(levels.shape[1:], np.bool_))
    _, panel = camera.shutter(code, camera.panel_at_rest(), 1)
    return camera.expected_electrons(truth, 1, code, panel)[0]


def _worst(found: Doubles, expected: Doubles) -> float:
    error = (found - expected) / expected.max()
    return float(error.ravel()[np.abs(error).argmax()])


def _complementary(*, slow: bool) -> float:
    camera = _camera(2.88, response="nominal" if slow else "ideal")
    rng = np.random.default_rng(25)
    light = rng.uniform(0, 2, (_SLOTS, 3 * _ROWS, 3 * _COLS)).astype(np.float32)
    levels = rng.integers(0, 2, (_SLOTS, _ROWS, _COLS)).astype(np.uint8) * np.uint8(255)
    ends = [np.full_like(levels, level) for level in (0, 255)]
    one, other, off, on = (_frame(camera, light, each) for each in (levels, 255 - levels, *ends))
    return _worst(one + other, on + off)


def _all_on(shift_px: float) -> float:
    """Sharp rectangle of 2 W m^-2 sr^-1 whose borders fall within CCD pixels, through a slow panel."""
    camera = _camera(2.88, response="nominal", **_SHARP)
    relay = camera.relay.model_copy(update={"shift_y_px": 0.3 + shift_px, "shift_x_px": -0.45})
    camera = camera.model_copy(update={"relay": relay})
    picture = np.zeros((_SLOTS, 3 * _ROWS, 3 * _COLS), np.float32)
    picture[:, 100:161, 200:322] = 2.0
    found = _frame(camera, picture, np.full((_SLOTS, _ROWS, _COLS), 255, np.uint8))
    covered = [
        np.clip(np.minimum(np.arange(n) + 1, stop) - np.maximum(np.arange(n), start), 0, 1)
        for n, side, first, end, shift in (
            (368, 3 * _ROWS, 100, 161, 0.3),
            (488, 3 * _COLS, 200, 322, -0.45),
        )
        for start, stop in [(0.96 * (np.array([first, end]) - side / 2) + n / 2 + shift)]
    ]
    irradiance = np.pi * 2.0 * 0.9 / (4 * 6.0**2) * _bright() * 0.92 / (2.88 * 4.54 / 20) ** 2
    joules = irradiance * _SLOTS * _SLOT_S * 4.54e-6**2
    electrons = 0.663 * joules / (6.62607015e-34 * 299792458.0 / 550e-9)
    return _worst(found, electrons * np.outer(*covered))


def _bright() -> float:
    """Transmission of splitter, polarisers and bright panel for light that is half p, half s."""
    total = 0.0
    for inbound, analysed, other in (
        (0.95 * 0.9, 0.99 * 0.9, 0.03 * 0.9 / 1000),
        (0.001 * 0.9 / 1000, 0.03 * 0.9 / 1000, 0.99 * 0.9),
    ):
        mixed = (analysed + other) / 2
        kept = (1 - 0.0137) * analysed + 0.0137 * mixed
        total += 0.5 * 0.97 * inbound * (0.70 * kept + 0.08 * 0.05 * mixed)
    return total


def _shifted(ratio: float, panel_px: int, ccd_px: int, *, code_way: int) -> float:
    """Shift down and to the left, of a scene that is dark around, so that the panel's edge has no say."""
    camera = _camera(ratio, response="nominal")
    rng = np.random.default_rng(27)
    light = np.zeros((_SLOTS, 3 * _ROWS, 3 * _COLS), np.float32)
    light[:, 120:240, 150:330] = rng.uniform(0, 2, (_SLOTS, 120, 180))
    levels = rng.integers(0, 256, (_SLOTS, _ROWS, _COLS)).astype(np.uint8)
    way = np.array([1, -1])
    there = np.roll(light, 3 * panel_px * way, (1, 2)), np.roll(levels, code_way * panel_px * way, (1, 2))
    found, frame = _frame(camera, *there), _frame(camera, light, levels)
    # What lies on the panel's image, which leaves 14 pixels of the CCD, before and after: there the panel's
    # edge cuts light off, and so it does a little of what PSFs bring from beyond it, 14 pixels more.
    rim = ccd_px + 28
    inner = np.s_[rim:-rim, rim:-rim]
    return _worst(np.roll(found, -ccd_px * way, (0, 1))[inner], frame[inner])
