# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false
"""Response times of the panel, from flashes around a change of its level.

Under constant light a frame shows little but the difference of the two time constants; so the bench
looks inside a slot, with flashes much shorter than it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares

from optsim.calibrate.bench import Step
from optsim.calibrate.shading import Picker
from optsim.errors import BenchError
from optsim.forward.panel import PanelResponse, mean_intensity, settled_retardance
from optsim.quantities import Bools, Doubles

# Bounds and start of the fit as shares of a slot; below the lower one a panel counts as instantaneous.
_LEAST, _FIRST, _MOST = 1e-4, 0.15, 5.0
_LIT = 0.5


def step_weight(step: Step, tau_on_s: float, tau_off_s: float, leak: float, exponent: float) -> float:
    """Weight of the panel during a step's flash, by the closed form of the relaxing retardance."""
    begin, end = settled_retardance(np.array([step.before, step.after], np.uint8), exponent).astype(float)
    tau_s = tau_on_s if end > begin else tau_off_s
    early_s = min(max(-step.delay_s, 0.0), step.flash_s)
    late_s = step.flash_s - early_s
    light = early_s * np.sin(begin / 2) ** 2
    if late_s > 0:
        waited = np.exp(-max(step.delay_s, 0.0) / tau_s) if tau_s > 0 else float(step.delay_s <= 0)
        light += late_s * float(mean_intensity(end + (begin - end) * waited, end, late_s, tau_s))
    return leak + (1 - leak) * float(light) / step.flash_s


def response_times(
    steps: tuple[Step, ...], picker: Picker, valid: Bools, slot_s: float, leak: float, exponent: float | None
) -> PanelResponse:
    """Fit both time constants and the flash's energy to the mean signals, by least squares.

    Parameters
    ----------
    steps : tuple of Step
        Flashes around changes in both directions.
    picker : Picker
        Where to read.
    valid : ndarray of shape (v, u), bool
        Panel pixels to average over.
    slot_s : float
        Duration of a slot, s.
    leak : float
        Off over on.
    exponent : float or None
        Of the grey curve; None takes the panel model's default.

    Returns
    -------
    PanelResponse
        The whole response as estimated.

    Raises
    ------
    BenchError
        When a direction is missing, or no light is seen.
    """
    if not any(s.after > s.before for s in steps) or not any(s.after < s.before for s in steps):
        raise BenchError("bench steps: expected steps to a higher and to a lower level; take both")
    grey = PanelResponse().drive_exponent if exponent is None else exponent
    row, col, black = picker.row[valid], picker.col[valid], picker.black_dn[valid]
    brightest = max(steps, key=lambda s: float(np.mean(s.dn[:, row, col])))
    light = brightest.dn[:, row, col].mean(axis=0) - black
    # The flash need not fill the picture; where it is weak there is nothing to learn.
    full = float(np.percentile(light, 99.9))
    if full < 20 * picker.noise.read_noise_dn:
        raise BenchError(
            f"bench steps: even the brightest has {full:.1f} DN only; check that flash and exposure meet"
        )
    lit = light > _LIT * full
    row, col, black = row[lit], col[lit], black[lit]
    level = float(np.mean(black, dtype=np.float64))
    signal = np.array([np.mean(s.dn[:, row, col], dtype=np.float64) for s in steps]) - level
    peak = float(signal.max())
    samples = np.array([len(s.dn) for s in steps]) * black.size
    noise = picker.noise
    sigma = np.sqrt((noise.dn_per_e * np.maximum(signal, 0) + noise.read_noise_dn**2) / samples)

    def misfit(guess: Doubles) -> Doubles:
        energy, on, off = guess
        weights = [step_weight(s, on * slot_s, off * slot_s, leak, grey) for s in steps]
        return (energy * peak * np.array(weights) - signal) / sigma

    fit = least_squares(
        misfit, [1.0, _FIRST, _FIRST], bounds=([0, _LEAST, _LEAST], [10, _MOST, _MOST]), x_scale="jac"
    )
    _, on, off = (float(value) for value in fit.x)
    return PanelResponse(tau_on_s=on * slot_s, tau_off_s=off * slot_s, leak=leak, drive_exponent=grey)
