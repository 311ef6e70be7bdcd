"""Render settings: error targets of the truth, and the camera's noise at which sampling may stop."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from optsim.core.config import Part


class RenderSettings(Part):
    """Error targets of the truth; samples follow from them, pixel by pixel.

    An error is the root mean square over pixels of the Monte-Carlo standard deviation divided by (radiance +
    1 % of the scene's white), for both halves together and per fine sample. A panel pixel's error is
    ``samples_per_pitch`` times smaller. Samples are allocated by predictions from other random numbers. The
    two halves of every truth measure the error reached. The defaults keep the truth's noise below the
    decoders' errors (no source).

    Parameters
    ----------
    static_error : float
        Target for the light without movers, rendered once.
    change_error : float
        Target for the movers' change elsewhere (shadows, bounce light), at each key instant.
    moving_error : float
        Target on the movers' own pixels in each slot, or on the whole picture if the camera moves.
    interpolation_error : float
        Bound on the error by interpolating in time between rendered poses, relative like the others. With the
        measured motion it sets the spacing of poses and key instants.
    key_seeds : int
        Sets of random numbers that the key instants use in turn, so that their noise is not frozen.
    slots_per_segment : int, optional
        Slots between key instants, instead of those set by ``interpolation_error``; divides the slots of a
        coded frame.
    instants_per_slot : int
        Truth instants a slot. Poses are integrated over an instant exactly, but the panel has one weight in
        it. With one instant instead of twelve, a bar moving 1 to 3 panel pixels a slot changes a frame by up
        to 0.06 (grey) or 0.3 (white) of its noise. With n instants that is n times smaller.
    noise_share : float, optional
        Stop sampling a pixel when its Monte-Carlo error is below this share of the camera's noise in a slot
        there. Unset: only the targets count.
    seed : int
        Seed of all random numbers of the rendering.
    """

    static_error: float = Field(0.06, gt=0.0005, le=2)
    change_error: float = Field(0.15, gt=0.001, le=2)
    moving_error: float = Field(0.35, gt=0.001, le=2)
    interpolation_error: float = Field(0.15, gt=0.0005, le=1)
    key_seeds: int = Field(4, ge=1, le=64)
    slots_per_segment: int | None = Field(None, ge=1, le=36)
    instants_per_slot: int = Field(1, ge=1, le=32)
    noise_share: float | None = Field(None, gt=0, le=10)
    seed: int = Field(0, ge=0)


@dataclass(frozen=True)
class CameraNoise:
    """The camera's noise for a radiance, in one slot and one fine sample."""

    electrons: float  # Photo-electrons per W m^-2 sr^-1.
    read_noise_e: float  # Standard deviation of the noise that doesn't depend on light.
