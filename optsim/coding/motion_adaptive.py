"""The paper's scheme (section 3.1): a random code for moving pixels, the HDR mosaic elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import Crosstalk
from optsim.coding.change_test import Changes
from optsim.coding.closed_loop_density import ClosedLoopDensity
from optsim.coding.growth import swept_ahead
from optsim.coding.hdr_mosaic import HdrMosaic
from optsim.coding.periodic import PeriodicCode, PeriodicScheme
from optsim.coding.random_exposure import RandomExposure
from optsim.coding.static_schemes import AnyStaticScheme, StaticScheme
from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, SCHEMES, or_offered
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.optics.neighbourhoods import dilated

_ForStatic = Annotated[
    AnyStaticScheme | ClosedLoopDensity, Field(discriminator="kind"), or_offered(SCHEMES, Part), AS_IT_IS
]


@dataclass(frozen=True, eq=False)
class AdaptiveState:
    """State of the adaptive scheme between frames."""

    static: Any  # State of the scheme of static pixels.
    moving: PeriodicCode
    changes: Changes  # What the frames that have arrived tell of motion.
    chosen: int | None = None  # The first frame whose code motion chose.


class MotionAdaptive(Part):
    """Choose the code of each pixel by whether it changed between the last two frames that have arrived.

    The latency is set by the caller through ``arrived``. The decoder gets the cleaned motion mask. The moving
    code extends one patch beyond it, so that every patch touching the mask has this code only.

    Parameters
    ----------
    static, moving : scheme
        Codes for pixels that stand still and for those that move. The static one may follow the brightness
        (``closed_loop_density``): it gets the same frames, of pixels that moved too.
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
    static: _ForStatic = HdrMosaic()
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
        changes = Changes.of(calibration, self.crosstalk)
        return AdaptiveState(self.static.init(calibration, rng), self.moving.init(calibration, rng), changes)

    def next(
        self, index: int, arrived: Sequence[CodedFrame], state: AdaptiveState
    ) -> tuple[ExposureCode, AdaptiveState]:
        """Code of frame ``index`` from all frames that have arrived."""
        thresholds = self.threshold_sigma, self.least_change, self.release_sigma
        # Glare of lamps that saturate in every frame cancels only while their exposure stays the same.
        apart = None if isinstance(self.static, PeriodicScheme) else state.chosen
        changes, chosen = state.changes.after(arrived, *thresholds, apart=apart), state.chosen
        if changes.n_seen < 2:
            decoded = np.full(changes.label.shape, self.first_frames == "moving")
        else:
            chosen = index if chosen is None else chosen
            decoded, before = changes.masks(self.speck_px, self.dilation_px)
            if self.growth == "displacement":
                # The newest frame that arrived is n_seen - 1: the mask is this many frames old.
                decoded = swept_ahead(decoded, before, index - (changes.n_seen - 1))
        shown = dilated(decoded, self.patch_px - 1 + self.psf_px)
        still, static = self.static.next(index, arrived, state.static)
        levels = np.where(shown, state.moving.levels(index), still.levels)
        return ExposureCode(levels, decoded), replace(state, static=static, changes=changes, chosen=chosen)
