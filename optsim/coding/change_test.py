"""Change test of a scheme: pixels whose light changed between the last two frames that have arrived."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import (
    Crosstalk,
    DemixedFrame,
    SaturationPrior,
    check_crosstalk,
    demixed_interval,
    next_demixed_frame,
)
from optsim.core.quantities import Bools, CodedFrame, PanelState
from optsim.optics.motion import changed
from optsim.optics.neighbourhoods import dilated, remove_specks


@dataclass(frozen=True, eq=False)
class Changes:
    """State of the change test between frames.

    Parameters
    ----------
    calibration : Calibration
        The camera as measured on the bench.
    crosstalk : {"undone", "row_summed"}
        Correction of the neighbours' light before frames are compared.
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
    crosstalk: Crosstalk
    panel: PanelState | None
    n_seen: int
    last: DemixedFrame | None
    seen: SaturationPrior
    label: Bools
    label_before: Bools

    @classmethod
    def of(cls, calibration: Calibration, crosstalk: Crosstalk) -> Changes:
        """Start before any frame.

        Raises
        ------
        ConfigError
            When crosstalk is to be undone and cannot be.
        """
        check_crosstalk(calibration, crosstalk)
        none = np.zeros(calibration.shape, np.bool_)
        prior = SaturationPrior.unknown(calibration.shape)
        return cls(calibration, crosstalk, None, 0, None, prior, none, none)

    def after(
        self,
        arrived: Sequence[CodedFrame],
        threshold_sigma: float,
        least_change: float,
        release_sigma: float | None = None,
        *,
        apart: int | None = None,
    ) -> Changes:
        """Compare the frames that are new among the arrived ones; thresholds as of the scheme that asks.

        The frame of index ``apart`` isn't compared with the one before.
        """
        changes = self
        for frame in arrived[self.n_seen :]:
            after = changes._after(frame, threshold_sigma, least_change, release_sigma)
            if frame.index == apart:
                after = replace(after, label=changes.label, label_before=changes.label_before)
            changes = after
        return changes

    def masks(self, speck_px: int, dilation_px: int) -> tuple[Bools, Bools]:
        """Give the pixels that changed, and those before the last frame: cleaned of specks, then dilated."""
        now, before = (
            dilated(remove_specks(label, speck_px), dilation_px) for label in (self.label, self.label_before)
        )
        return now, before

    def _after(
        self,
        frame: CodedFrame,
        threshold_sigma: float,
        least_change: float,
        release_sigma: float | None,
    ) -> Changes:
        # Saturated pixels keep their earlier irradiance: right if nothing moves, which is what the test
        # assumes.
        demixed, panel, seen = next_demixed_frame(
            self.calibration, frame, self.panel, self.seen, self.crosstalk
        )
        label = self.label
        if self.last is not None:
            before, now = (demixed_interval(self.calibration, s) for s in (self.last, demixed))
            moved, undecided = changed(before, now, threshold_sigma, least_change=least_change)
            if release_sigma is not None:
                lower = changed(before, now, release_sigma, least_change=least_change)[0]
                moved |= label & lower
            label = np.where(undecided, label, moved)
        return replace(
            self,
            panel=panel,
            n_seen=self.n_seen + 1,
            last=demixed,
            seen=seen,
            label=label,
            label_before=self.label,
        )
