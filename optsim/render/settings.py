"""How finely the truth is rendered."""

from __future__ import annotations

from pydantic import Field

from optsim.config import Part


class RenderSettings(Part):
    """Sample counts and steps of the truth; the defaults are those of the demo (fine grid 480 x 360).

    All sample counts are per fine sample, both halves together, so they are even; a panel pixel gets
    ``samples_per_pitch ** 2`` times as many. Defaults are chosen so that the truth's own noise stays below
    the decoders' errors (no source; measured by the two halves of every truth).

    Parameters
    ----------
    static_samples : int
        Of the light without movers, once.
    key_samples : int
        Of what the movers change elsewhere (shadows, bounce light), at each key instant.
    key_seeds : int
        Sets of random numbers that the key instants take in turn, so that their noise doesn't freeze.
    mover_samples : int
        On the movers' own pixels, in each slot.
    slots_per_segment : int
        Slots between key instants; divides the slots of a coded frame.
    max_step_px : float
        Farthest that any visible point of a mover moves between two poses, fine samples.
    instants_per_slot : int
        Truth instants a slot; poses are integrated over an instant exactly, so few are enough.
    seed : int
        Of all random numbers.
    """

    static_samples: int = Field(256, ge=2, le=65536, multiple_of=2)
    key_samples: int = Field(6, ge=2, le=1024, multiple_of=2)
    key_seeds: int = Field(4, ge=1, le=64)
    mover_samples: int = Field(10, ge=2, le=4096, multiple_of=2)
    slots_per_segment: int = Field(9, ge=1, le=36)
    max_step_px: float = Field(2.0, gt=0.05, le=50)
    instants_per_slot: int = Field(1, ge=1, le=32)
    seed: int = Field(0, ge=0)
