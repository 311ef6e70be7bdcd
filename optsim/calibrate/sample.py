# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false
"""A coded frame as each panel pixel saw it by itself: the light of the neighbours taken out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np
from scipy import ndimage

from optsim.calibrate.calibration import Calibration
from optsim.errors import ConfigError
from optsim.forward.motion import Bounds, bounds
from optsim.quantities import Bools, CodedFrame, Floats, Ints, PanelState

Crosstalk = Literal["undone", "row_summed"]
_REMAINDER = 1e-4


@dataclass(frozen=True, eq=False)
class Sample:
    """One coded frame on the panel grid: ``signal = sum over slots of weight x irradiance``, with its error.

    Parameters
    ----------
    weights : ndarray of shape (slot, v, u), float32
        Weights that belong to ``signal``.
    exposure : ndarray of shape (v, u), float32
        Their sum over the slots.
    measured : ndarray of shape (v, u), float32
        The signal with crosstalk, W m^-2 slots; a lower bound where saturated.
    signal : ndarray of shape (v, u), float32
        The signal of each pixel by itself (or ``measured``, with row-summed weights).
    variance : ndarray of shape (v, u), float32
        Noise variance of ``signal``.
    saturated, valid : ndarray of shape (v, u), bool
        As in :class:`~optsim.calibrate.calibration.Observation`.
    tainted : ndarray of shape (v, u), bool
        Light of a saturated neighbour, of unknown amount, is in ``signal``: it is an upper bound.
    """

    weights: Floats
    exposure: Floats
    measured: Floats
    signal: Floats
    variance: Floats
    saturated: Bools
    valid: Bools
    tainted: Bools


def take(
    calibration: Calibration, frame: CodedFrame, panel: PanelState | None, crosstalk: Crosstalk
) -> tuple[Sample, PanelState]:
    """Observe a frame and separate its pixels.

    Parameters
    ----------
    calibration : Calibration
        The camera as the bench knows it.
    frame : CodedFrame
        The frame.
    panel : PanelState or None
        The panel when the frame started; None for the first frame of an experiment.
    crosstalk : {"undone", "row_summed"}
        "undone" inverts the calibrated kernel, which acts on the image after the slots have been summed, so
        this is right for every code and scene; "row_summed" leaves the light where it is and adds the
        neighbours' share to the weights, right only where the scene is the same over the kernel.

    Returns
    -------
    sample : Sample
    panel : PanelState
        The panel when the next frame starts.

    Raises
    ------
    ConfigError
        When "undone" is asked for and the kernel is too wide to invert by iteration.
    """
    seen = calibration.observe(frame)
    weigh = calibration.effective_weights if crosstalk == "row_summed" else calibration.weights
    weights, panel = weigh(frame.code, panel)
    sample = Sample(
        weights,
        weights.sum(axis=0, dtype=np.float64).astype(np.float32),
        seen.signal,
        seen.signal,
        seen.variance,
        seen.saturated,
        seen.valid,
        np.zeros_like(seen.valid),
    )
    if crosstalk == "undone":
        sample = replace(sample, variance=separated_variance(calibration, seen.variance))
        sample = separate(calibration, sample, None)
    return sample, panel


def separate(calibration: Calibration, sample: Sample, estimate: Floats | None) -> Sample:
    """Take everybody else's light out of ``measured``: solve ``calibration.mix(signal) = measured``.

    Saturated pixels give what ``estimate`` says they did, but no less than they were measured to give.
    Pixels that are not valid are taken to look like the nearest valid one.

    Parameters
    ----------
    calibration : Calibration
        Holds the kernel.
    sample : Sample
        The frame.
    estimate : ndarray of shape (v, u), float32, or None
        Irradiance of the pixels from elsewhere, W m^-2; NaN where unknown.
    """
    centre = _own_share(calibration)
    known = np.zeros_like(sample.saturated) if estimate is None else np.isfinite(estimate)
    pinned = sample.saturated | ~sample.valid
    pins = sample.measured
    if not sample.valid.all() and sample.valid.any():
        pins = (pins / np.maximum(sample.exposure, 1e-6))[nearest(sample.valid)] * sample.exposure
    if estimate is not None:
        pins = np.where(known, np.maximum(estimate * sample.exposure, pins), pins)
    rate = max(float(((1 - centre) / centre).max()), calibration.veil + calibration.ghost)
    steps = 0 if rate < 1e-6 else int(np.ceil(np.log(_REMAINDER) / np.log(rate)))
    # The signal of an earlier call is a good start; at first it is what was measured.
    signal = np.where(pinned, pins, sample.signal)
    for _ in range(steps):
        change = (sample.measured - calibration.mix(signal)) / centre
        change[pinned] = 0
        signal += change
        if np.abs(change).max() <= _REMAINDER * np.abs(signal).max():
            break
    loud = (sample.saturated & ~known).astype(np.float32)
    tainted = (calibration.spread(loud[None])[0] > _REMAINDER) & ~sample.saturated
    return replace(sample, signal=signal, tainted=tainted)


def separated_variance(calibration: Calibration, variance: Floats) -> Floats:
    """Noise variance after crosstalk was undone: own noise and, to first order, that of the neighbours."""
    centre = _own_share(calibration)
    around = calibration.spread_variance(variance)
    return ((variance + around / centre**2) / centre**2).astype(np.float32)


def noise_variance(calibration: Calibration, measured: Floats) -> Floats:
    """Predicted shot and read noise of a signal that is known, W^2 m^-4 slots^2."""
    dn = np.maximum(measured, 0) * calibration.responsivity_dn
    variance = (dn * calibration.dn_per_e + calibration.read_noise_dn**2) / calibration.responsivity_dn**2
    return variance.astype(np.float32)


def sample_bounds(calibration: Calibration, sample: Sample) -> Bounds:
    """Bounds of a frame's irradiance, with the calibration's own uncertainties as model error."""
    leaked = calibration.response.leak * calibration.coded_slots
    return bounds(
        sample.signal,
        sample.exposure,
        sample.variance,
        (calibration.dn_per_e / calibration.responsivity_dn).astype(np.float32),
        sample.saturated,
        sample.tainted,
        sample.valid,
        gain_uncertainty=calibration.gain_uncertainty,
        exposure_uncertainty=calibration.leak_uncertainty * leaked,
        map_residual_px=calibration.map_residual_px,
    )


def nearest(found: Bools) -> tuple[Ints, Ints]:
    """Row and column of the nearest pixel of a mask, for every pixel."""
    transform = cast("Callable[..., Ints]", ndimage.distance_transform_edt)
    rows, cols = transform(~found, return_distances=False, return_indices=True)
    return rows, cols


def _own_share(calibration: Calibration) -> Floats:
    share = calibration.own_share
    least = float(share.min())
    if least <= 0.5:
        raise ConfigError(
            f"crosstalk: a pixel keeps only {least:.2f} of its light; expected more than 0.5 to undo it; "
            "cure: a sharper relay, or crosstalk = 'row_summed'"
        )
    return share
