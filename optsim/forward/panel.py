# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""What a pixel of a liquid-crystal panel lets through in a slot, from its drive level and its history.

A pixel is a reflective retarder between crossed polarisers: it passes ``sin^2(Gamma / 2)`` of the light,
Gamma being its round-trip retardance (D.-K. Yang and S.-T. Wu, *Fundamentals of Liquid Crystal Devices*,
2nd ed., Wiley 2014, ch. 2). Gamma relaxes exponentially towards the value that its drive level asks for,
with one time constant towards larger and another towards smaller retardance. A field-sequential panel
has a slot of a few such constants, so each slot carries some of the one before.

The mean over an interval is closed form. With D = Gamma(0) - Gamma_inf and d = D exp(-dt / tau),

    mean cos Gamma = cos Gamma_inf (1 - tau/dt (Cin D - Cin d)) - sin Gamma_inf tau/dt (Si D - Si d)

where Cin x = integral of (1 - cos z) / z from 0 to x (NIST DLMF, section 6.2). It is tabulated over the start
retardance for each level in use, and interpolated linearly: off by at most ``TABLE_ERROR``.

Not modelled: the twist of twisted-nematic panels, row scan, polarity ripple, fringing fields.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike
from pydantic import Field
from scipy.special import sici

from optsim.config import Part
from optsim.errors import ValueCheckError
from optsim.quantities import Bytes, Doubles, Floats

_CELLS = 512
# Linear interpolation errs by h^2/8 max|f''| with h = pi/512 and |f''| <= 1/2, plus float32 rounding.
TABLE_ERROR = 3e-6


class PanelResponse(Part):
    """How the panel, seen through its polarisers, answers its drive.

    Parameters
    ----------
    tau_on_s, tau_off_s : float
        Time constants towards larger and towards smaller retardance, s; 0 is instantaneous.
    leak : float
        Transmission of the whole chain fully off over fully on, 1/CR; 0 is infinite contrast.
    drive_exponent : float
        Exponent of retardance against level; 1.2 has no source, it is a sensible default.
    """

    tau_on_s: float = Field(default=0.5e-3, ge=0)
    tau_off_s: float = Field(default=1.0e-3, ge=0)
    leak: float = Field(default=0.01, ge=0, le=1)
    drive_exponent: float = Field(default=1.2, gt=0)


def settled_retardance(levels: Bytes, drive_exponent: float) -> Floats:
    """Retardance that each drive level reaches if it is held, rad: pi (level / 255)^exponent."""
    curve = np.pi * (np.arange(256) / 255.0) ** drive_exponent
    return curve.astype(np.float32)[levels]


def settled_weight(levels: Bytes, response: PanelResponse) -> Floats:
    """Weight of each drive level if it is held for ever; 1 at level 255."""
    intensity = np.sin(settled_retardance(levels, response.drive_exponent) / 2) ** 2
    return (response.leak + (1 - response.leak) * intensity).astype(np.float32)


def mean_intensity(start_rad: ArrayLike, target_rad: float, duration_s: float, tau_s: float) -> Doubles:
    """Mean of sin^2(Gamma / 2) over an interval in which Gamma relaxes from start towards target.

    Parameters
    ----------
    start_rad : array_like
        Retardance at the beginning, rad; any shape.
    target_rad : float
        Retardance that the drive asks for, rad.
    duration_s, tau_s : float
        Length of the interval (> 0) and time constant (>= 0), s.

    Returns
    -------
    ndarray of the shape of ``start_rad``, float64
        Mean intensity, 0..1.
    """
    step = np.asarray(start_rad, np.float64) - target_rad
    if tau_s == 0:
        return np.full(step.shape, np.sin(target_rad / 2) ** 2)
    share = tau_s / duration_s
    rest = step * np.exp(-duration_s / tau_s)
    (si_step, cin_step), (si_rest, cin_rest) = _si_cin(step), _si_cin(rest)
    cosine = np.cos(target_rad) * (1 - share * (cin_step - cin_rest))
    cosine -= np.sin(target_rad) * share * (si_step - si_rest)
    return (1 - cosine) / 2


def _si_cin(x: Doubles) -> tuple[Doubles, Doubles]:
    """Sine integral (odd) and the entire cosine integral Cin (even)."""
    size = np.abs(x)
    large = np.maximum(size, 1e-3)
    si, ci = sici(large)
    # gamma + ln x - Ci x cancels near zero, where two terms of the series are exact to 1e-21.
    cin = np.where(size > 1e-3, np.euler_gamma + np.log(large) - ci, size**2 / 4 - size**4 / 96)
    return np.where(size > 1e-3, np.sign(x) * si, x - x**3 / 18), cin


def slot_weights(
    levels: Bytes,
    retardance_rad: Floats,
    response: PanelResponse,
    slot_s: float,
    instants_per_slot: int = 1,
) -> tuple[Floats, Floats]:
    """Effective weight of every panel pixel in every instant, with the pixel's history.

    Parameters
    ----------
    levels : ndarray of shape (slot, v, u), uint8
        Drive levels.
    retardance_rad : ndarray of shape (v, u), float32
        Retardance when the first slot begins, 0..pi.
    response : PanelResponse
        True or estimated response.
    slot_s : float
        Duration of a slot, s.
    instants_per_slot : int
        Instants to a slot.

    Returns
    -------
    weights : ndarray of shape (slot * instants_per_slot, v, u), float32
        Mean over the instant of leak + (1 - leak) sin^2(Gamma / 2): 1 for a pixel that has always been on.
    end_retardance : ndarray of shape (v, u), float32
        Retardance when the last slot ends.

    Raises
    ------
    ValueCheckError
        When the shapes of levels and retardance don't agree.
    """
    if levels.ndim != 3 or levels.shape[1:] != retardance_rad.shape:
        raise ValueCheckError(
            f"levels {levels.shape} and retardance {retardance_rad.shape} are of different panels; "
            "expected (slot, v, u) and (v, u)"
        )
    tables, targets, decays = _tables(levels, response, slot_s / instants_per_slot)
    n_slots, n_v, n_u = levels.shape
    weights = np.empty((n_slots * instants_per_slot, n_v * n_u), np.float32)
    state = np.clip(retardance_rad, 0, np.pi).astype(np.float32).ravel()
    flat = np.ascontiguousarray(levels).reshape(n_slots, -1)
    _run(flat, state, tables, targets, decays, instants_per_slot, weights)
    return weights.reshape(-1, n_v, n_u), state.reshape(n_v, n_u)


def _tables(levels: Bytes, response: PanelResponse, duration_s: float) -> tuple[Floats, Floats, Floats]:
    """Weights over start retardance, targets and decays for the levels in use: [level, 2, node] and so on.

    Index 0 holds starts below the target (tau_on), index 1 starts above it: the kink between the two
    time constants falls on a node.
    """
    targets = settled_retardance(np.arange(256, dtype=np.uint8), response.drive_exponent)
    tables = np.zeros((256, 2, _CELLS + 1), np.float32)
    taus = (response.tau_on_s, response.tau_off_s)
    for level in np.flatnonzero(_used(np.ascontiguousarray(levels).ravel())):
        target = float(targets[level])
        ends = ((0.0, target), (target, np.pi))
        for side in (0, 1):
            start = np.linspace(*ends[side], _CELLS + 1)
            intensity = mean_intensity(start, target, duration_s, taus[side])
            tables[level, side] = response.leak + (1 - response.leak) * intensity
    decays = [np.exp(-duration_s / tau) if tau > 0 else 0.0 for tau in taus]
    return tables, targets, np.array(decays, np.float32)


@njit(nogil=True, cache=True)
def _used(levels: Bytes) -> Bytes:
    used = np.zeros(256, np.uint8)
    for level in levels:
        used[level] = 1
    return used


@njit(nogil=True, cache=True)
def _run(
    levels: Bytes,
    state: Floats,
    tables: Floats,
    targets: Floats,
    decays: Floats,
    n_sub: int,
    weights: Floats,
) -> None:
    pi = np.float32(np.pi)
    for slot in range(levels.shape[0]):
        for sub in range(n_sub):
            row = weights[slot * n_sub + sub]
            for pixel in range(levels.shape[1]):
                level = levels[slot, pixel]
                start, target = state[pixel], targets[level]
                side = 0 if start < target else 1
                low, high = (np.float32(0), target) if side == 0 else (target, pi)
                place = (start - low) / max(high - low, np.float32(1e-12)) * np.float32(_CELLS)
                cell = min(max(int(place), 0), _CELLS - 1)
                part = place - np.float32(cell)
                table = tables[level, side]
                row[pixel] = table[cell] + part * (table[cell + 1] - table[cell])
                state[pixel] = target + (start - target) * decays[side]
