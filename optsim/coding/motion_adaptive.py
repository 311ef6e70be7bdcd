"""The paper's scheme (section 3.1): a random code for moving pixels, the HDR mosaic elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import (
    Crosstalk,
    DemixedFrame,
    SaturationPrior,
    check_crosstalk,
    demixed_interval,
    next_demixed_frame,
)
from optsim.coding.growth import swept_ahead
from optsim.coding.hdr_mosaic import HdrMosaic
from optsim.coding.periodic import PeriodicCode
from optsim.coding.random_exposure import RandomExposure
from optsim.coding.static_schemes import StaticScheme
from optsim.core.config import Part
from optsim.core.quantities import Bools, CodedFrame, ExposureCode, PanelState
from optsim.optics.motion import changed
from optsim.optics.neighbourhoods import dilated, remove_specks


@dataclass(frozen=True, eq=False)
class AdaptiveState:
    """State of the adaptive scheme between frames.

    Parameters
    ----------
    calibration : Calibration
        The camera as measured on the bench.
    static, moving : PeriodicCode
        The two codes it chooses from.
    panel : PanelState or None
        The panel after the last frame that arrived; None before there is one.
    n_seen : int
        Frames that have arrived.
    last : DemixedFrame or None
        The last frame that arrived.
    seen : SaturationPrior
        Saturation prior of each pixel, from its last frames.
    label : ndarray of shape (v, u), bool
        Pixels that changed between the last two frames, before clean-up.
    label_before : ndarray of shape (v, u), bool
        The same before the last frame arrived.
    """

    calibration: Calibration
    static: PeriodicCode
    moving: PeriodicCode
    panel: PanelState | None
    n_seen: int
    last: DemixedFrame | None
    seen: SaturationPrior
    label: Bools
    label_before: Bools


class MotionAdaptive(Part):
    """Choose the code of each pixel by whether it changed between the last two frames that have arrived.

    The latency is set by the caller through ``arrived``. The decoder gets the cleaned motion mask. The moving
    code extends one patch beyond it, so that every patch touching the mask has this code only.

    Parameters
    ----------
    static, moving : scheme
        Codes for pixels that stand still and for those that move.
    threshold_sigma : float
        Change that counts as motion, in predicted standard deviations. The paper gives no value; 4 is a
        sensible default. Noise alone then triggers 1 pixel in 16 000. In the dark, where squares of pixels
        are tested too, it triggers up to three.
    least_change : float
        Least relative change of the mean over 3 x 3 or 5 x 5 pixels, used where single pixels are too noisy.
        For a smaller change a random code, with its fewer photons, would lose more than it shows. 0.2 was
        chosen on ``window_room`` and ``half_moving`` at a sixteenth of their light.
    speck_px : int
        Changed regions of fewer panel pixels are dropped from the motion mask.
    dilation_px : int
        Reach of the dilation of the motion mask, pixels (the paper dilates, by an amount it does not give).
    patch_px : int
        Side of the decoder's patches, panel pixels: a whole patch gets the moving code.
    psf_px : int
        Extra reach for light that spreads between pixels.
    first_frames : {"moving", "static"}
        Class of all pixels until two frames have arrived.
    crosstalk : {"undone", "row_summed"}
        Correction of the neighbours' light before frames are compared.
    release_sigma : float, optional
        Hysteresis in time: a moving pixel stays so while its change exceeds this lower threshold. Slow or
        low-contrast motion then keeps its code. Hysteresis in space (J. Canny, IEEE Trans. Pattern Anal.
        Mach. Intell. 8, 679 (1986)) would add the surroundings of a clear change; the dilation does that
        already. None is off; no source for a value.
    growth : {"none", "displacement"}
        "displacement" sweeps each region of the mask ahead (:func:`~optsim.coding.growth.swept_ahead`), by
        its measured displacement a frame times the mask's delay in frames.
    """

    kind: Literal["motion_adaptive"] = "motion_adaptive"
    static: StaticScheme = HdrMosaic()
    moving: StaticScheme = RandomExposure()
    threshold_sigma: float = Field(default=4.0, gt=0)
    least_change: float = Field(default=0.2, ge=0)
    speck_px: int = Field(default=4, ge=1)
    dilation_px: int = Field(default=3, ge=0)
    patch_px: int = Field(default=8, ge=1)
    psf_px: int = Field(default=1, ge=0)
    first_frames: Literal["moving", "static"] = "moving"
    crosstalk: Crosstalk = "undone"
    release_sigma: float | None = Field(default=None, gt=0)
    growth: Literal["none", "displacement"] = "none"

    @model_validator(mode="after")
    def _released_below_the_threshold(self) -> MotionAdaptive:
        if self.release_sigma is not None and self.release_sigma >= self.threshold_sigma:
            raise ValueError(
                f"release_sigma: got {self.release_sigma:g}, expected less than threshold_sigma, which is "
                f"{self.threshold_sigma:g}; lower it, or leave it out"
            )
        return self

    def init(self, calibration: Calibration, rng: np.random.Generator) -> AdaptiveState:
        """Start before any frame.

        Raises
        ------
        ConfigError
            When crosstalk is to be undone and cannot be.
        """
        check_crosstalk(calibration, self.crosstalk)
        return AdaptiveState(
            calibration,
            self.static.init(calibration, rng),
            self.moving.init(calibration, rng),
            None,
            n_seen=0,
            last=None,
            seen=SaturationPrior.unknown(calibration.shape),
            label=np.zeros(calibration.shape, np.bool_),
            label_before=np.zeros(calibration.shape, np.bool_),
        )

    def next(
        self, index: int, arrived: Sequence[CodedFrame], state: AdaptiveState
    ) -> tuple[ExposureCode, AdaptiveState]:
        """Code of frame ``index`` from all frames that have arrived."""
        for frame in arrived[state.n_seen :]:
            state = self._learn(frame, state)
        if state.n_seen < 2:
            decoded = np.full(state.label.shape, self.first_frames == "moving")
        else:
            decoded = self._cleaned(state.label)
            if self.growth == "displacement":
                # The newest frame that arrived is n_seen - 1: the mask is this many frames old.
                decoded = swept_ahead(decoded, self._cleaned(state.label_before), index - (state.n_seen - 1))
        shown = dilated(decoded, self.patch_px - 1 + self.psf_px)
        levels = np.where(shown, state.moving.levels(index), state.static.levels(index))
        return ExposureCode(levels, decoded), state

    def _cleaned(self, label: Bools) -> Bools:
        return dilated(remove_specks(label, self.speck_px), self.dilation_px)

    def _learn(self, frame: CodedFrame, state: AdaptiveState) -> AdaptiveState:
        # Saturated pixels keep their earlier irradiance: right if nothing moves, which is what the test
        # assumes.
        demixed, panel, seen = next_demixed_frame(
            state.calibration, frame, state.panel, state.seen, self.crosstalk
        )
        label = state.label
        if state.last is not None:
            before, now = (demixed_interval(state.calibration, s) for s in (state.last, demixed))
            moved, undecided = changed(before, now, self.threshold_sigma, least_change=self.least_change)
            if self.release_sigma is not None:
                lower = changed(before, now, self.release_sigma, least_change=self.least_change)[0]
                moved |= label & lower
            label = np.where(undecided, label, moved)
        return replace(
            state,
            panel=panel,
            n_seen=state.n_seen + 1,
            last=demixed,
            seen=seen,
            label=label,
            label_before=state.label,
        )
