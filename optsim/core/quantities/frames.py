"""Values that panel, camera and decoder exchange: codes, panel state, coded frames, reconstructions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities.arrays import Bools, Bytes, Floats, Words, checked


@dataclass(frozen=True, eq=False)
class ExposureCode:
    """The commanded code of one coded frame.

    Parameters
    ----------
    levels : ndarray of shape (slot, v, u), uint8
        Drive level, 0 (dark) to 255 (bright).
    moving : ndarray of shape (v, u), bool
        Pixels with a temporal code, for the sparse decoder; the others are coded as static.
    """

    levels: Bytes
    moving: Bools

    def __post_init__(self) -> None:
        checked("levels", self.levels, axes=("slot", "v", "u"), dtype=np.uint8, unit="drive level")
        checked("moving", self.moving, axes=("v", "u"), dtype=np.bool_, unit="mask")
        if self.moving.shape != self.levels.shape[1:]:
            raise ValueCheckError(
                f"moving mask {self.moving.shape} and levels {self.levels.shape} are of different panels"
            )


@dataclass(frozen=True, eq=False)
class PanelState:
    """The panel's memory from one frame to the next.

    Parameters
    ----------
    retardance_rad : ndarray of shape (v, u), float32
        Round-trip retardance: 0 is dark, pi brightest.
    levels : ndarray of shape (v, u), uint8
        Drive levels of the last slot: rows that are driven late still relax towards them.
    slots_displayed : int
        Slots since the panel was switched on; decides the field that comes next.
    """

    retardance_rad: Floats
    levels: Bytes
    slots_displayed: int = 0

    def __post_init__(self) -> None:
        checked("retardance", self.retardance_rad, axes=("v", "u"), dtype=np.float32, unit="rad")
        checked("levels", self.levels, axes=("v", "u"), dtype=np.uint8, unit="drive level")
        if self.levels.shape != self.retardance_rad.shape:
            raise ValueCheckError(
                f"panel state: levels {self.levels.shape} and retardance {self.retardance_rad.shape} are of "
                "different panels"
            )


@dataclass(frozen=True, eq=False)
class CodedFrame:
    """A digital frame of the CCD together with the code shown during it.

    Parameters
    ----------
    index : int
        Coded-frame index, from 0.
    dn : ndarray of shape (y, x), uint16
        Raw digital numbers on the CCD.
    code : ExposureCode
        Commanded code.
    negative_light : int
        CCD pixels with negative expected light (Monte-Carlo noise of the truth), exposed as dark.
    earlier : bool
        True for a frame that only later ones need: nobody reads its own reconstruction, and none is made.
    """

    index: int
    dn: Words
    code: ExposureCode
    negative_light: int = 0
    earlier: bool = False

    def __post_init__(self) -> None:
        checked("dn", self.dn, axes=("y", "x"), dtype=np.uint16, unit="DN")


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A decoder's estimate of the scene during one coded frame.

    Parameters
    ----------
    index : int
        Coded-frame index.
    irradiance_w_m2 : ndarray of shape (slot, v, u), float32
        Mean irradiance on the modulator in each slot, objective shading divided out.
    valid : ndarray of shape (v, u), bool
        False where the decoder has no measurement; not scored, but counted.
    interpolated : ndarray of shape (v, u), bool
        Filled from neighbours rather than measured.
    moving : ndarray of shape (v, u), bool
        Pixels whose light the decoder treated as changing.
    uncertainty_w_m2 : ndarray of shape (slot, v, u), float32, or None
        Standard deviation of the irradiance as the decoder predicts it, before negative light is clipped. It
        has no meaning where not valid. 0 where the decoder predicts none, None if it predicts none anywhere.
    """

    index: int
    irradiance_w_m2: Floats
    valid: Bools
    interpolated: Bools
    moving: Bools
    uncertainty_w_m2: Floats | None = None

    def __post_init__(self) -> None:
        checked(
            "reconstruction", self.irradiance_w_m2, axes=("slot", "v", "u"), dtype=np.float32, unit="W m^-2"
        )
        for name in ("valid", "interpolated", "moving"):
            checked(name, getattr(self, name), axes=("v", "u"), dtype=np.bool_, unit="mask")
        spread = self.uncertainty_w_m2
        if spread is not None:
            checked("uncertainty", spread, axes=("slot", "v", "u"), dtype=np.float32, unit="W m^-2")
            if spread.shape != self.irradiance_w_m2.shape:
                raise ValueCheckError(
                    f"uncertainty: got an array of shape {spread.shape}, expected that of the irradiance, "
                    f"{self.irradiance_w_m2.shape}; cure: one standard deviation a slot and pixel"
                )
