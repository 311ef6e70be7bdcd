"""Effective weights of a liquid-crystal panel: transmission of a pixel in a slot by drive level and history.

A pixel is a reflective retarder between crossed polarisers. It passes ``sin^2(Gamma / 2)`` of the light, with
round-trip retardance Gamma (D.-K. Yang and S.-T. Wu, *Fundamentals of Liquid Crystal Devices*, 2nd ed., Wiley
2014, ch. 2). Gamma relaxes exponentially towards the target of its drive level, with one time constant for
rising and another for falling retardance. A slot of a field-sequential panel is a few time constants long, so
each slot depends on the one before.

The rows are written one after the other, with a delay against the shutter's clock. Until it is driven a row
continues towards the level of the slot before. An early row is driven before a slot begins, so it shows the
next slot's level at the end of each. At the end of the last slot that is the level of the first again: the
next frame's code is not known when a frame is taken. A colour-sequential panel drives its three fields
differently, and its voltage alternates in sign from field to field. Neither is balanced exactly, so the
target of a level repeats only after several slots.

The mean over an interval is closed form. With D = Gamma(0) - Gamma_inf and d = D exp(-dt / tau),

    mean cos Gamma = cos Gamma_inf (1 - tau/dt (Cin D - Cin d)) - sin Gamma_inf tau/dt (Si D - Si d)

where Cin x = integral of (1 - cos z) / z from 0 to x (NIST DLMF, section 6.2). Cin and Si are polynomials
with an error of 1e-10 times the larger of 1 and tau/dt, and weights are float32. Together the error is at
most ``WEIGHT_ERROR`` for time constants of up to a hundred slots.

Not modelled: the twist of twisted-nematic panels, ripple faster than a slot.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field

from optsim.core.config import Part
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bytes, Doubles, Floats, Ints, PanelState
from optsim.optics.relaxation import si_cin, walk

# Half a unit in the last place of 1 in float32, and as much again for the integrals.
WEIGHT_ERROR = 1.2e-7


def _measured(pairs: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """Refuse a grey curve that does not rise from level 0 to 255."""
    if not pairs:
        return pairs
    first, last = pairs[0], pairs[-1]
    rising = all(a < b and low < high for (a, low), (b, high) in pairwise(pairs))
    if len(pairs) < 2 or (first[0], last[0]) != (0, 255) or not rising or first[1] < 0:
        raise ValueError(
            f"got {len(pairs)} pairs from level {first[0]:g} to {last[0]:g}, expected levels from 0 to 255 "
            "and reflectances of 0 or more, both rising; cure: sort it, and smooth noise out of it"
        )
    return pairs


GreyCurve = Annotated[tuple[tuple[float, float], ...], AfterValidator(_measured)]
"""Level and reflectance of a panel, measured with it held; empty for none."""


class PanelResponse(Part):
    """Response of the panel between its polarisers to its drive.

    Parameters
    ----------
    tau_on_s, tau_off_s : float
        Time constants towards larger and towards smaller retardance, s; 0 is instantaneous.
    leak : float
        Transmission of the whole chain fully off over fully on, 1/CR; 0 is infinite contrast.
    white_rad : float
        Retardance of level 255 at the wavelength in use; pi is a half wave, the brightest state.
    drive_exponent : float
        Exponent of retardance against level; 1.2 has no source, it is a sensible default.
    grey_curve : tuple of (float, float)
        Level and reflectance in any unit, as measured with the panel held, from level 0 to 255, both rising;
        linear in the retardance between them. It replaces the exponent; empty: none was measured.
    field_drive : tuple of float
        Relative retardance of successive slots, repeated; (1,) for a panel with equal slots.
    delay_s, scan_s : float
        Delay at which the first row is driven to a slot's level, after the slot's start, and scan time from
        it to one row after the last. Together less than a slot. A negative delay is early, by less than a
        slot.
    """

    tau_on_s: float = Field(default=0.5e-3, ge=0)
    tau_off_s: float = Field(default=1.0e-3, ge=0)
    leak: float = Field(default=0.01, ge=0, le=1)
    white_rad: float = Field(default=np.pi, gt=0, lt=2 * np.pi)
    drive_exponent: float = Field(default=1.2, gt=0)
    grey_curve: GreyCurve = ()
    field_drive: tuple[float, ...] = (1.0,)
    delay_s: float = 0.0
    scan_s: float = Field(default=0.0, ge=0)

    @property
    def white(self) -> float:
        """Transmission of level 255, held, over that of a half wave."""
        return float(np.sin(self.white_rad / 2) ** 2)

    def row_delays_s(self, rows: int) -> Doubles:
        """Delay of each row against a slot's start, s; negative is early."""
        return self.delay_s + self.scan_s * (np.arange(rows) + 0.5) / rows


def settled_retardance(levels: Bytes, response: PanelResponse) -> Floats:
    """Retardance of each drive level when held, rad: white (level / 255)^exponent."""
    return _curve(response).astype(np.float32)[levels]


def settled_panel(levels: Bytes, response: PanelResponse) -> PanelState:
    """State of a panel that has held an image of levels, (v, u), for many response times.

    Between fields that are driven differently it never fully settles: the error is their difference times
    exp(-slot / tau).
    """
    held = settled_retardance(levels, response) * np.float32(response.field_drive[-1])
    return PanelState(held, levels, 0)


def first_panel(levels: Bytes, response: PanelResponse, slot_s: float) -> PanelState:
    """State at the start of an experiment: long dark, then one cycle of these levels, (slot, v, u)."""
    dark = settled_panel(np.zeros(levels.shape[1:], np.uint8), response)
    return slot_weights(levels, dark, response, slot_s)[1]


def drive_targets(response: PanelResponse, slots_displayed: int, n_slots: int) -> Doubles:
    """Target retardance of each level, from the slot before the first to that after the last: (slot, 256)."""
    n_fields = len(response.field_drive)
    drive = [response.field_drive[(slots_displayed + k) % n_fields] for k in range(-1, n_slots + 1)]
    return np.array(drive)[:, None] * _curve(response)


def early_rows(response: PanelResponse, rows: int) -> int:
    """Count the first rows that are driven before a slot begins."""
    return int(np.count_nonzero(response.row_delays_s(rows) < 0))


def row_switching(
    response: PanelResponse, rows: int, instant_s: float, slot_s: float
) -> tuple[Ints, Doubles]:
    """Instant of a slot in which each row is driven (early rows to the next slot), and the time after it."""
    delays_s = response.row_delays_s(rows) % slot_s
    switch_at = np.floor(delays_s / instant_s).astype(np.int64)
    return switch_at, delays_s - switch_at * instant_s


def switched(levels: Bytes, panel: PanelState, response: PanelResponse) -> tuple[Bytes, PanelState]:
    """Level to which each row is driven within each slot, and the panel when the first slot begins.

    A late row is driven to the slot's own level. An early one shows that already, and is driven to the next
    slot's.
    """
    early = slice(0, early_rows(response, levels.shape[1]))
    if not early.stop:
        return levels, panel
    displayed, driven = panel.levels.copy(), levels.copy()
    displayed[early], driven[:, early] = levels[0, early], np.roll(levels[:, early], -1, axis=0)
    return driven, PanelState(panel.retardance_rad, displayed, panel.slots_displayed)


def settled_weight(levels: Bytes, response: PanelResponse) -> Floats:
    """Weight of each drive level when held, with equal fields; 1 at level 255."""
    intensity = np.sin(settled_retardance(levels, response) / 2) ** 2 / response.white
    return (response.leak + (1 - response.leak) * intensity).astype(np.float32)


def mean_intensity(
    start_rad: ArrayLike, target_rad: ArrayLike, duration_s: ArrayLike, tau_s: ArrayLike
) -> Doubles:
    """Mean of sin^2(Gamma / 2) over an interval in which Gamma relaxes from start towards target.

    Parameters
    ----------
    start_rad : array_like
        Retardance at the beginning, rad.
    target_rad : array_like
        Target retardance, rad.
    duration_s, tau_s : array_like
        Length of the interval (> 0) and time constant (> 0), s.

    Returns
    -------
    ndarray of the arguments' common shape, float64
        Mean intensity, 0..1.
    """
    start, target, duration, tau = (
        np.asarray(a, np.float64) for a in (start_rad, target_rad, duration_s, tau_s)
    )
    step, share = start - target, tau / duration
    rest = step * np.exp(-1 / share)
    (si_step, cin_step), (si_rest, cin_rest) = si_cin(step), si_cin(rest)
    cosine = np.cos(target) * (1 - share * (cin_step - cin_rest))
    cosine = cosine - np.sin(target) * share * (si_step - si_rest)
    return (1 - cosine) / 2


def slot_weights(
    levels: Bytes,
    panel: PanelState | None,
    response: PanelResponse,
    slot_s: float,
    instants_per_slot: int = 1,
    leak: Doubles | None = None,
) -> tuple[Floats, PanelState]:
    """Effective weight of every panel pixel in every instant, with the pixel's history.

    Parameters
    ----------
    levels : ndarray of shape (slot, v, u), uint8
        Drive levels.
    panel : PanelState or None
        The panel when the first slot begins; None at the start of an experiment (:func:`first_panel`).
    response : PanelResponse
        True or estimated response.
    slot_s : float
        Duration of a slot, s.
    instants_per_slot : int
        Instants to a slot.
    leak : ndarray of shape (u,), float64, optional
        Off over on of each column, if it varies.

    Returns
    -------
    weights : ndarray of shape (slot * instants_per_slot, v, u), float32
        Mean over the instant of leak + (1 - leak) sin^2(Gamma / 2) / sin^2(white / 2). It is 1 for a pixel
        that has always been on. It exceeds 1 at intermediate levels if white is above a half wave.
    panel : PanelState
        The panel when the last slot ends.

    Raises
    ------
    ValueCheckError
        When the shapes don't agree, the last row is driven after the slot's end, or a target exceeds a whole
        wave.
    """
    if panel is None:
        panel = first_panel(levels, response, slot_s)
    if levels.ndim != 3 or levels.shape[1:] != panel.retardance_rad.shape:
        raise ValueCheckError(
            f"levels {levels.shape} and panel state {panel.retardance_rad.shape} are of different panels; "
            "expected (slot, v, u) and (v, u)"
        )
    n_slots, rows, cols = levels.shape
    if response.delay_s + response.scan_s >= slot_s or response.delay_s <= -slot_s:
        raise ValueCheckError(
            f"delay_s + scan_s: got {response.delay_s:g} + {response.scan_s:g} s, expected less than the "
            f"slot of {slot_s:g} s, and delay_s more than minus a slot"
        )
    if (most_rad := response.white_rad * max(response.field_drive)) > 2 * np.pi:
        raise ValueCheckError(
            f"white_rad x field_drive: got {most_rad:.3g} rad, expected at most a whole wave, 2 pi"
        )
    targets = drive_targets(response, panel.slots_displayed, n_slots)
    instant_s = slot_s / instants_per_slot
    switch_at, early_s = row_switching(response, rows, instant_s, slot_s)
    levels, panel = switched(levels, panel, response)
    taus = np.array([response.tau_on_s, response.tau_off_s])
    leaks = np.full(cols, response.leak) if leak is None else np.asarray(leak, np.float64)
    spans = (1 - leaks) / response.white
    weights = np.empty((n_slots * instants_per_slot, rows, cols), np.float32)
    retardance, displayed = panel.retardance_rad.copy(), panel.levels.copy()

    n_early = early_rows(response, rows)
    for part, ahead in ((slice(0, n_early), 1), (slice(n_early, rows), 0)):
        if part.start < part.stop:
            walk(
                levels[:, part], retardance[part], displayed[part], targets[ahead : ahead + n_slots + 1],
                taus, switch_at[part], early_s[part], instant_s, leaks, spans, weights[:, part],
            )  # fmt: skip
    return weights, PanelState(retardance, displayed, panel.slots_displayed + n_slots)


def _curve(response: PanelResponse) -> Doubles:
    if response.grey_curve:
        levels, reflectance = np.array(response.grey_curve, np.float64).T
        # The light at level 0 is the leak, which is added elsewhere.
        share = response.white * (reflectance - reflectance[0]) / (reflectance[-1] - reflectance[0])
        held = 2 * np.arcsin(np.sqrt(share))
        return np.array(np.interp(np.arange(256), levels, held), np.float64)
    return response.white_rad * (np.arange(256) / 255.0) ** response.drive_exponent
