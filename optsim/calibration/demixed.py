# pyright: reportMissingTypeStubs=false
"""Demixed frames: a coded frame with crosstalk and glare removed, so that each pixel has its own light."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, CodedFrame, Doubles, Floats, Ints, PanelState
from optsim.optics.motion import IrradianceInterval, irradiance_interval

Crosstalk = Literal["undone", "row_summed"]
_REMAINDER = 1e-4
LEAST_EXPOSURE = 1e-6
"""Slots; a pixel with less exposure gives no irradiance."""
# A pixel must keep this share of its own light, or it cannot be separated from its neighbours'.
_LEAST_SHARE = 1 / 3
# The iteration converges for own shares above a half, faster for larger ones. Below a half it would overshoot
# in even light, so a larger share sets the step. The last is the slowest convergence rate that is iterated to
# the end.
_ENOUGH, _LARGER, _SLOWEST = 0.5, 0.6, 0.95


@dataclass(frozen=True, eq=False)
class DemixedFrame:
    """One coded frame on the panel grid: ``signal = sum over slots of weight x irradiance``, with its error.

    Parameters
    ----------
    weights : ndarray of shape (slot, v, u), float32
        Weights that belong to ``signal``.
    exposure : ndarray of shape (v, u), float32
        Their sum over the slots.
    gathered : ndarray of shape (v, u), float32
        ``measured`` for 1 W m^-2 everywhere; crosstalk includes the neighbours' exposures.
    measured : ndarray of shape (v, u), float32
        The signal with crosstalk, W m^-2 slots; a lower bound where saturated.
    signal : ndarray of shape (v, u), float32
        The signal of each pixel by itself (or ``measured``, with row-summed weights).
    variance : ndarray of shape (v, u), float32
        Variance of ``signal`` by noise and attribution.
    attribution : ndarray of shape (v, u), float32
        Part of it that is :func:`attribution_variance`.
    saturated, valid : ndarray of shape (v, u), bool
        As in :class:`~optsim.calibration.calibration.Observation`.
    tainted : ndarray of shape (v, u), bool
        ``signal`` includes an unknown amount of a saturated neighbour's light: it is an upper bound.
    """

    weights: Floats
    exposure: Floats
    gathered: Floats
    measured: Floats
    signal: Floats
    variance: Floats
    attribution: Floats
    saturated: Bools
    valid: Bools
    tainted: Bools

    @property
    def uniform(self) -> Floats:
        """Irradiance in uniform surroundings, W m^-2, (v, u): a lower bound where saturated."""
        return (self.measured / np.maximum(self.gathered, np.float32(1e-6))).astype(np.float32, copy=False)

    @property
    def floor(self) -> Floats:
        """Irradiance of a saturated pixel from its own exposure alone, W m^-2, (v, u); 0 for the others.

        It is too high where neighbours with longer exposures brought light. It is too low where the pixel
        saturated by far. It is the only estimate for a pixel that saturates in every frame.
        """
        bound = self.measured / np.maximum(self.exposure, np.float32(1e-6))
        return np.where(self.saturated & self.valid, bound, 0).astype(np.float32)


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameWithHighlights(CodedFrame):
    """A coded frame whose saturated pixels have a known light, from other frames or from its glare.

    Parameters
    ----------
    highlights_w_m2 : ndarray of shape (v, u), float32
        Irradiance; it counts where the frame saturates.
    """

    highlights_w_m2: Floats


@dataclass(frozen=True, eq=False)
class SaturationPrior:
    """Saturation prior: a pixel's irradiance from other frames, for frames in which it saturates.

    Parameters
    ----------
    irradiance : ndarray of shape (v, u), float32
        W m^-2; NaN where no frame measured it.
    floor : ndarray of shape (v, u), float32
        Estimate from saturated frames (:attr:`DemixedFrame.floor`), W m^-2.
    """

    irradiance: Floats
    floor: Floats

    @classmethod
    def unknown(cls, shape: tuple[int, int]) -> SaturationPrior:
        """Prior before the first frame."""
        return cls(np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32))

    def after(self, demixed: DemixedFrame) -> SaturationPrior:
        """Update by one more frame: the newest measurement counts, or the highest bound since."""
        measured = demixed.valid & ~demixed.saturated & ~demixed.tainted & (demixed.exposure > 0)
        mean = demixed.signal / np.maximum(demixed.exposure, np.float32(1e-6))
        return SaturationPrior(
            np.where(measured, mean, self.irradiance).astype(np.float32),
            np.where(measured, 0, np.maximum(self.floor, demixed.floor)).astype(np.float32),
        )


def demixed_frame(
    calibration: Calibration, frame: CodedFrame, panel: PanelState | None, crosstalk: Crosstalk
) -> tuple[DemixedFrame, PanelState]:
    """Demix one frame."""
    seen = calibration.observe(frame)
    weigh = calibration.effective_weights if crosstalk == "row_summed" else calibration.weights
    weights, panel = weigh(frame.code, panel)
    exposure = weights.sum(axis=0, dtype=np.float64).astype(np.float32)
    demixed = DemixedFrame(
        weights,
        exposure,
        calibration.mix(exposure) if crosstalk == "undone" else exposure,
        seen.signal,
        seen.signal,
        seen.variance,
        np.zeros_like(seen.variance),
        seen.saturated,
        seen.valid,
        np.zeros_like(seen.valid),
    )
    if crosstalk == "undone":
        noise = demixed_variance(calibration, seen.variance)
        demixed = demix(
            calibration, replace(demixed, variance=noise), SaturationPrior.unknown(calibration.shape)
        )
        opened = np.maximum(demixed.exposure, np.float32(1e-6))
        rough = np.maximum(demixed.signal / opened, np.float32(0))
        error = attribution_variance(
            calibration, demixed.exposure, rough, (noise / opened**2).astype(np.float32)
        )
        demixed = replace(demixed, variance=noise + error, attribution=error)
    return demixed, panel


def next_demixed_frame(
    calibration: Calibration,
    frame: CodedFrame,
    panel: PanelState | None,
    seen: SaturationPrior,
    crosstalk: Crosstalk,
) -> tuple[DemixedFrame, PanelState, SaturationPrior]:
    """Demix the next frame of a video; earlier frames give the irradiance of saturated pixels.

    Parameters
    ----------
    calibration, frame, panel, crosstalk
        As of :func:`demixed_frame`.
    seen : SaturationPrior
        Saturation prior from the frames before.

    Returns
    -------
    demixed : DemixedFrame
    panel : PanelState
        The panel when the next frame starts.
    seen : SaturationPrior
        The prior updated by this frame.
    """
    demixed, panel = demixed_frame(calibration, frame, panel, crosstalk)
    if crosstalk == "undone":
        demixed = demix(calibration, demixed, seen)
    return demixed, panel, seen.after(demixed)


def check_crosstalk(calibration: Calibration, crosstalk: Crosstalk) -> None:
    """Refuse to undo crosstalk that cannot be undone.

    Raises
    ------
    ConfigError
        With the cure.
    """
    if crosstalk == "undone":
        _own_share(calibration)


def demixed_frames(
    frames: Iterable[CodedFrame], calibration: Calibration, crosstalk: Crosstalk
) -> Iterator[tuple[CodedFrame, DemixedFrame]]:
    """Demix the frames of a video in turn; earlier ones give the irradiance of saturated pixels.

    Raises
    ------
    ConfigError
        When crosstalk cannot be undone, before the first frame is asked for.
    """
    check_crosstalk(calibration, crosstalk)
    panel: PanelState | None = None
    seen = SaturationPrior.unknown(calibration.shape)
    for frame in frames:
        demixed, panel, seen = next_demixed_frame(calibration, frame, panel, seen, crosstalk)
        if isinstance(frame, FrameWithHighlights) and crosstalk == "undone" and demixed.saturated.any():
            demixed = _without_glare(calibration, demixed, frame.highlights_w_m2)
        yield frame, demixed


def _without_glare(calibration: Calibration, demixed: DemixedFrame, highlights: Floats) -> DemixedFrame:
    """Subtract the glare of highlights beyond their measured bounds; crosstalk stays as it is."""
    more = (highlights * demixed.exposure - demixed.signal).clip(0)
    glare = np.zeros_like(demixed.signal)
    for _ in range(2):  # the second round: subtracted light causes no glare itself
        glare = calibration.mix_far(np.where(demixed.saturated, more, -glare)) / calibration.direct_share
    return replace(demixed, signal=np.where(demixed.saturated, demixed.signal, demixed.signal - glare))


def demix(calibration: Calibration, demixed: DemixedFrame, elsewhere: SaturationPrior) -> DemixedFrame:
    """Remove the other pixels' light from ``measured``: solve ``calibration.mix(signal) = measured``.

    Saturated pixels take their irradiance from other frames, but at least that of uniform surroundings. With
    their neighbours' exposures they may have gathered several times their own light. Pixels that are not
    valid get the value of the nearest valid one.

    Parameters
    ----------
    calibration : Calibration
        Holds the kernel.
    demixed : DemixedFrame
        The frame.
    elsewhere : SaturationPrior
        Saturation prior from other frames.
    """
    share = _own_share(calibration)
    centre = np.where(share > _ENOUGH, share, np.float32(_LARGER))
    known = np.isfinite(elsewhere.irradiance)
    pinned = demixed.saturated | ~demixed.valid
    pins = demixed.measured
    if pinned.any():
        uniform = demixed.uniform
        if not demixed.valid.all() and demixed.valid.any():
            uniform = uniform[nearest(demixed.valid)]
        prior = np.fmax(elsewhere.irradiance, elsewhere.floor)
        pins = np.fmax(uniform, prior) * demixed.exposure
    # The signal of an earlier call is a good start; at first it is the measured signal.
    signal = np.where(pinned, pins, demixed.signal)
    # Glare is small and smooth: it is computed again after the near light has converged.
    for _ in range(_rounds(calibration.glare.share(calibration.reach))):
        near, before = demixed.measured - calibration.mix_far(signal), signal.copy()
        for _ in range(_rounds(float(((1 - share) / share).max()))):
            change = (near - calibration.mix_near(signal)) / centre
            change[pinned] = 0
            signal += change
            if _settled(change, signal):
                break
        if _settled(signal - before, signal):
            break
    unknown_light = (demixed.saturated & ~known).astype(np.float32)
    tainted = (calibration.spread(unknown_light[None])[0] > _REMAINDER) & ~demixed.saturated
    return replace(demixed, signal=signal, tainted=tainted)


def _rounds(rate: float) -> int:
    """Count steps until an error that shrinks by ``rate`` in each is negligible; at least one."""
    return 1 if rate < 1e-6 else int(np.ceil(np.log(_REMAINDER) / np.log(min(rate, _SLOWEST))))


def _settled(change: Floats | Doubles, signal: Floats) -> bool:
    return bool(np.abs(change).max() <= _REMAINDER * np.abs(signal).max())


def attribution_variance(
    calibration: Calibration, exposure: Floats, irradiance: Floats, variance: Floats | None = None
) -> Floats:
    """Variance of a demixed signal because the origin of crosstalk is ambiguous.

    On flats, which the kernel is measured on, light from the neighbour gives the same signal as own light
    passed by the neighbour's code (fringing fields; blur across an edge within a pixel). Any mixture of both
    is equally likely around the choice of :meth:`Calibration.mix` (a sensible default; no source).
    """
    own = calibration.own_share
    theirs, opened = calibration.spread(np.stack([irradiance * exposure, exposure]))
    opened -= own * exposure
    difference = (theirs - own * irradiance * exposure - irradiance * opened) / own
    squared = difference**2
    if variance is not None:
        noise = calibration.spread_variance(exposure**2 * variance) + opened**2 * variance
        squared = np.maximum(squared - 4 * noise / own**2, 0)
    # Variance of a uniform distribution whose half width is the difference.
    return (squared / 3).astype(np.float32)


def demixed_variance(calibration: Calibration, variance: Floats) -> Floats:
    """Noise variance after crosstalk was undone: own noise plus, to first order, the neighbours'."""
    # Higher orders are 7 to 12 % of it where a pixel keeps 0.6 of its light, 16 to 30 % at a half.
    centre = _own_share(calibration)
    around = calibration.spread_variance(variance)
    return ((variance + around / centre**2) / centre**2).astype(np.float32)


def noise_variance(calibration: Calibration, measured: Floats) -> Floats:
    """Predict shot and read noise of a known signal, W^2 m^-4 slots^2."""
    dn = np.maximum(measured, 0) * calibration.responsivity_dn
    variance = (dn * calibration.dn_per_e + calibration.read_noise_dn**2) / calibration.responsivity_dn**2
    return variance.astype(np.float32)


def predicted_variance(calibration: Calibration, exposure: Floats, irradiance: Floats) -> Floats:
    """Variance of a demixed signal, by noise and attribution, for a known irradiance.

    Parameters
    ----------
    calibration : Calibration
        Holds the kernel.
    exposure, irradiance : ndarray of shape (v, u), float32
        As of :func:`attribution_variance`; none negative.
    """
    noise = noise_variance(calibration, calibration.mix(irradiance * exposure))
    return demixed_variance(calibration, noise) + attribution_variance(calibration, exposure, irradiance)


def demixed_interval(calibration: Calibration, demixed: DemixedFrame) -> IrradianceInterval:
    """Irradiance intervals of a frame, with the calibration's own uncertainties as model error."""
    leaked = calibration.response.leak * calibration.coded_slots
    # Equal pixels are rounded equally: rounding does not average out.
    common = np.minimum(demixed.attribution + 1 / (12 * calibration.responsivity_dn**2), demixed.variance)
    return irradiance_interval(
        demixed.signal,
        demixed.exposure,
        demixed.variance,
        common.astype(np.float32),
        (calibration.dn_per_e / calibration.responsivity_dn).astype(np.float32),
        demixed.saturated,
        demixed.tainted,
        demixed.valid,
        gain_uncertainty=calibration.gain_uncertainty,
        exposure_uncertainty=calibration.leak_uncertainty * leaked,
        map_residual_px=calibration.map_residual_px,
    )


def nearest(found: Bools) -> tuple[Ints, Ints]:
    """Row and column of the nearest pixel of a mask, for every pixel."""
    from scipy import ndimage

    transform = cast("Callable[..., Ints]", ndimage.distance_transform_edt)
    rows, cols = transform(~found, return_distances=False, return_indices=True)
    return rows, cols


def _own_share(calibration: Calibration) -> Floats:
    share = calibration.own_share
    least = float(share.min())
    if least <= _LEAST_SHARE:
        kept = (
            f"keeps only {least:.2f} of its light" if least > 0 else "keeps none of its light that was found"
        )
        raise ConfigError(
            f"crosstalk: a pixel {kept}; expected more than a third to undo it; "
            "cure: a sharper relay, or crosstalk = 'row_summed'"
        )
    return share
