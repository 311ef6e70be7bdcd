"""How accurately the truth is rendered."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from optsim.core.config import Part


class RenderSettings(Part):
    """Error targets of the truth; samples follow from them, pixel by pixel.

    An error here is the root mean square over pixels of Monte-Carlo standard deviation divided by
    (radiance + 1 % of the scene's white), both halves together, per fine sample; a panel pixel's is
    ``samples_per_pitch`` times smaller. Targets are met by prediction from other random numbers; what was
    reached is measured by the two halves of every truth. Defaults are chosen so that the truth's own
    noise stays below the decoders' errors (no source).

    Parameters
    ----------
    static_error : float
        Target of the light without movers, rendered once.
    change_error : float
        Target of what the movers change elsewhere (shadows, bounce light), at each key instant.
    moving_error : float
        Target on the movers' own pixels in each slot; on the whole picture when the camera moves.
    interpolation_error : float
        Bound on what interpolating in time between rendered poses may add, relative like the others: it
        decides how far apart poses and key instants are, from the measured flow.
    key_seeds : int
        Sets of random numbers that the key instants take in turn, so that their noise doesn't freeze.
    slots_per_segment : int, optional
        Slots between key instants instead of those that ``interpolation_error`` allows; divides the slots
        of a coded frame.
    instants_per_slot : int
        Truth instants a slot. Poses are integrated over an instant exactly, but the panel is taken to have
        one weight in it: with one instant a bar of 1 to 3 panel pixels a slot changes a frame by up to 0.06
        (grey) or 0.3 (white) of its noise against twelve; n instants make that n times smaller.
    noise_share : float, optional
        Stop sampling a pixel where the camera couldn't tell: when its Monte-Carlo error is below this share
        of the camera's own noise in a slot there. Unset: sample to the targets alone.
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
    """What the camera's noise is for a radiance, in one slot and one fine sample.

    Parameters
    ----------
    electrons : float
        Photo-electrons per W m^-2 sr^-1.
    read_noise_e : float
        Standard deviation of the noise that doesn't depend on light, electrons.
    """

    electrons: float
    read_noise_e: float
