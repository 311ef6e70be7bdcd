"""A panel late on the shutter's clock: what a slot's light shares with the next, and how it jitters."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.stats import chi2, norm

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import with_effects
from optsim.camera.hardware import demo
from optsim.core.quantities import Doubles, ExposureCode, PanelState
from optsim.footage.made import footage

CLAIM = (
    "a slot of an instantaneous panel lasts from its delay, late or early, to that of the next, row by row: "
    "its weights and the electrons of its light are shared exactly by time; the delay varies from frame to "
    "frame with the stated standard deviation, about the stated mean, independently"
)
ORACLE = (
    "overlap of two stretches of time on a piece of paper; scipy's quantiles of normal and chi-square laws"
)
SOURCE = (
    "definition of delay, row scan and jitter; sampling distributions of mean, variance and autocorrelation"
)
TOLERANCE = 1.0
REASON = (
    "In units of what is allowed: 1e-6 for weights and electrons, float32 of the order of one; for the "
    "three statistics what chance exceeds once in 1e5, so a false alarm once in 33 000 measures."
)
FILES = (
    "optsim/camera/camera.py",
    "optsim/optics/panel.py",
    "optsim/optics/relaxation.py",
    "optsim/camera/parts/modulator.py",
)

_EXACT, _CHANCE = 1e-6, 1e-5
_ROWS, _COLS, _SLOTS, _SLOT_S, _LIT = 24, 32, 6, 1 / 180, 2
_DELAY_S, _JITTER_S, _FRAMES = 0.6e-3, 0.12e-3, 3000


def measure() -> float:
    """Find the largest deviation, in units of what is allowed."""
    return max(_weights(1), _electrons(1), *_jitter(1.0), key=abs)


def perturbed() -> float:
    """Break each, return the least: rows written from below, early for late, a tenth more jitter."""
    return min(_weights(-1), _electrons(-1), _jitter(1.1)[0], key=abs)


def _camera(delay_s: float, scan_s: float = 0.0, jitter_s: float = 0.0) -> CodedCamera:
    camera = with_effects(demo(), {"all": "ideal"})
    late = {"delay_s": delay_s, "scan_s": scan_s, "jitter_s": jitter_s}
    parts = {
        "modulator": camera.modulator.model_copy(update=late),
        "sensor": camera.sensor.model_copy(update={"rows": 3 * _ROWS, "cols": 3 * _COLS}),
    }
    update = {"panel_rows": _ROWS, "panel_cols": _COLS, "slots_per_frame": _SLOTS}
    return camera.model_copy(update={**parts, **update})


def _bump() -> ExposureCode:
    levels = np.zeros((_SLOTS, _ROWS, _COLS), np.uint8)
    levels[_LIT] = 255
    return ExposureCode(levels, np.zeros((_ROWS, _COLS), np.bool_))


def _open(starts_s: Doubles, length_s: float, late_s: Doubles | float) -> Doubles:
    """Share of stretches of time in which a slot that comes late is shown."""
    first_s = _LIT * _SLOT_S + np.asarray(late_s)
    stretch = np.minimum(starts_s + length_s, first_s + _SLOT_S) - np.maximum(starts_s, first_s)
    return np.clip(stretch, 0, None) / length_s


def _weights(sign: int) -> float:
    """By row and instant, for several delays, scans and lengths of an instant."""
    worst = 0.0
    for delay_s, scan_s in (
        (0.0, 0.0), (1e-3, 0.0), (0.0, 3e-3), (0.7e-3, 1.7e-3), (2.5e-3, 3e-3), (-1e-3, 0.0), (-1e-3, 2e-3)
    ):  # fmt: skip
        for n_sub in (1, 3, 7):
            camera = _camera(delay_s, scan_s)
            found, _ = camera.panel_weights(_bump(), camera.panel_at_rest(), n_sub)
            # Used rows are in the middle of the panel's 768, all of which the scan takes.
            row = 768 / 2 + sign * (np.arange(_ROWS) + 0.5 - _ROWS / 2)
            starts_s = np.arange(_SLOTS * n_sub) * _SLOT_S / n_sub
            expected = _open(starts_s[:, None], _SLOT_S / n_sub, delay_s + scan_s * row / 768)
            error = found - expected[:, :, None]
            worst = max(worst, float(error.ravel()[np.abs(error).argmax()]), key=abs)
    return worst / _EXACT


def _electrons(sign: int) -> float:
    """Electrons of light that falls in one slot only, that of the bump or beside it, over those of all-on."""
    worst = 0.0
    for lit, delay_s in product((_LIT - 1, _LIT, _LIT + 1), (1.3e-3, -0.4e-3)):
        frames = np.zeros((_SLOTS, 3 * _ROWS, 3 * _COLS), np.float32)
        frames[lit] = 1
        camera = _camera(delay_s)
        truth = camera.form_image(footage(frames, slot_s=_SLOT_S, samples_per_pitch=3))
        always = ExposureCode(np.full((_SLOTS, _ROWS, _COLS), 255, np.uint8), _bump().moving)
        found, whole = (
            camera.expected_electrons(truth, 0, code, panel)[0].sum()
            for code, panel in ((_bump(), camera.panel_at_rest()), (always, None))
        )
        expected = _open(np.array(lit * _SLOT_S), _SLOT_S, sign * delay_s)
        worst = max(worst, float(found / whole - expected), key=abs)
    return worst / _EXACT


def _jitter(scale: float) -> list[float]:
    """Spread, mean and correlation of successive delays, in quantiles of what chance may do."""
    camera, code = _camera(_DELAY_S, jitter_s=scale * _JITTER_S), _bump()
    rest = camera.panel_at_rest()
    late_s = np.empty(_FRAMES)
    for frame in range(_FRAMES):
        panel = PanelState(rest.retardance_rad, rest.levels, slots_displayed=frame * _SLOTS)
        weights, _ = camera.panel_weights(code, panel, 1)
        late_s[frame] = float(weights[_LIT + 1, 0, 0]) * _SLOT_S
    variance = late_s.var(ddof=1) / _JITTER_S**2
    n = _FRAMES - 1
    bound = chi2.isf(_CHANCE / 2, n) if variance > 1 else chi2.ppf(_CHANCE / 2, n)
    seldom = norm.isf(_CHANCE / 2) / np.sqrt(_FRAMES)
    away = (late_s - late_s.mean()) / late_s.std()
    return [
        float((variance - 1) / abs(bound / n - 1)),
        float((late_s.mean() - _DELAY_S) / _JITTER_S / seldom),
        float((away[1:] * away[:-1]).mean() / seldom),
    ]
