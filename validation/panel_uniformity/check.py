"""Reflectivity over the panel and pixels that stand still, over many panels and through a camera."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.stats import binom, norm

from optsim.camera.effects import with_effects
from optsim.camera.hardware import demo, lcr720
from optsim.core.quantities import ExposureCode
from optsim.footage.made import still

CLAIM = (
    "a panel's reflectivity varies by the stated rms, differently for each specimen; as many pixels as "
    "stated stand still, half of them bright; whatever the code, they send on what they stand at, "
    "the others do not"
)
ORACLE = (
    "root mean square by numpy; counts in scipy's binomial law; light of open slots, all or none, by the "
    "photon budget. Which pixels stand still is asked of the camera's own list"
)
SOURCE = "binomial law of independent pixels; Born and Wolf, Principles of Optics, 7th ed., section 4.8"
TOLERANCE = 1.0
REASON = (
    "In units of what is allowed: 1e-5 for an rms of float32 numbers about 1, 1e-6 for float32 light; for "
    "the three statistics what chance exceeds once in 1e5, so a false alarm once in 33 000 measures."
)
FILES = ("optsim/camera/camera.py", "optsim/camera/parts/modulator.py", "optsim/camera/hardware/lcr720.py")

_RMS, _SHARE = 0.02, 1e-5
_EXACT, _LIGHT, _CHANCE = 1e-5, 1e-6, 1e-5
_ROWS, _COLS, _PANELS = 500, 600, 300


def measure() -> float:
    """Find the largest deviation, in units of what is allowed."""
    return max(_rms(1.0), _alike(0.0), _counts(1.0), _standing(mirrored=False), key=abs)


def perturbed() -> float:
    """Break each, return the least: rms 1 % up, all panels alike, share half up, stuck ones mirrored."""
    return min(_rms(1.01), _alike(1.0), _counts(1.5), _standing(mirrored=True), key=abs)


def _rms(scale: float) -> float:
    """Of the light that an even panel sends on, over many specimens and parts of it."""
    panel = lcr720().model_copy(update={"nonuniformity_rms": scale * _RMS})
    worst = 0.0
    for shape in ((_ROWS, _COLS), (120, 160), (30, 700)):
        for serial in range(20):
            gain = panel.gain(*shape, serial).astype(np.float64)
            worst = max(worst, gain.std() / gain.mean() / _RMS - 1, gain.mean() - 1, key=abs)
    return float(worst / _EXACT)


def _alike(share: float) -> float:
    """Mean correlation of two specimens: of random mixtures of 15 cosines, zero but for chance."""
    panel = lcr720()
    gains = [panel.gain(60, 80, serial).ravel() - 1.0 for serial in range(_PANELS + 1)]
    found = [np.corrcoef(a, share * a + (1 - share) * b)[0, 1] for a, b in pairwise(gains)]
    # Two random directions in n dimensions have a cosine of variance 1 / n. Orthogonal cosines, 9 of power
    # 1/4 and 6 of 1/2, are as many as (sum of powers)^2 / sum of squares.
    allowed = norm.isf(_CHANCE / 2) / np.sqrt(5.25**2 / 2.0625 * _PANELS)
    return float(np.mean(found) / allowed)


def _counts(scale: float) -> float:
    """Stuck pixels of many panels, and how many of them are bright."""
    panel = lcr720().model_copy(update={"stuck_share": scale * _SHARE})
    made = [panel.stuck(_ROWS, _COLS, serial) for serial in range(_PANELS)]
    n_stuck = sum(int(stuck.sum()) for stuck, _ in made)
    bright = sum(int((levels[stuck] == 255).sum()) for stuck, levels in made)
    others = sum(int(np.isin(levels[stuck], (0, 255), invert=True).sum()) for stuck, levels in made)
    pixels = _ROWS * _COLS * _PANELS
    deviations = [_in_quantiles(n_stuck, pixels, _SHARE), _in_quantiles(bright, n_stuck, 0.5), float(others)]
    return max(deviations, key=abs)


def _in_quantiles(count: int, n: int, share: float) -> float:
    """Distance of a count from its expectation, over that of the quantile that chance seldom passes."""
    away = count - n * share
    bound = binom.isf(_CHANCE / 2, n, share) if away > 0 else binom.ppf(_CHANCE / 2, n, share)
    return float(away / abs(bound - n * share))


def _standing(*, mirrored: bool) -> float:
    """Light of each panel pixel under random open and closed slots, over that of an open one throughout."""
    camera = with_effects(demo(), {"all": "ideal"})
    camera = camera.model_copy(
        update={"modulator": camera.modulator.model_copy(update={"stuck_share": 1e-2})}
    )
    shape = (camera.panel_rows, camera.panel_cols)
    flat = np.ones((3 * shape[0], 3 * shape[1]), np.float32)
    truth = camera.form_image(still(flat, n_slots=36, slot_s=camera.slot_s, samples_per_pitch=3))
    # Instantaneous, with perfect polarisers: unpolarised light loses half, and the rest by each part.
    passed = 0.5 * 0.9 * 0.95 * 0.70 * 0.99 * 0.9 * 0.97
    full = np.pi * 0.9 / (4 * 6.0**2) * passed * 36 / 180
    stuck, at = camera.stuck_pixels
    if mirrored:
        stuck, at = stuck[:, ::-1], at[:, ::-1]
    opened = np.random.default_rng(9).random((36, *shape)) < 0.4
    worst = 0.0
    for each in (opened, ~opened):
        code = ExposureCode(each.astype(np.uint8) * np.uint8(255), np.zeros(shape, np.bool_))
        shutter, _ = camera.shutter(code, None, 1)
        found = camera.panel_energy(truth, 0, shutter)[1::3, 1::3].astype(np.float64)
        error = found / full - np.where(stuck, at / 255, each.mean(axis=0))
        worst = max(worst, float(error.ravel()[np.abs(error).argmax()]), key=abs)
    return worst / _LIGHT
