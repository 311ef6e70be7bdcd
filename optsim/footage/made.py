"""Truth from arrays instead of the renderer: image sequences, and uniform fields for a bench."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Floats, RadianceVideo, Segment


def footage(
    frames: Floats, *, slot_s: float, samples_per_pitch: int = 1, white_w_m2_sr: float = 1.0
) -> RadianceVideo:
    """Make a radiance video from given slot means.

    Parameters
    ----------
    frames : ndarray of shape (slot, y, x), float32
        Mean radiance in each slot, W m^-2 sr^-1.
    slot_s : float
        Duration of a slot, s.
    samples_per_pitch : int
        Fine samples per panel pixel, along each axis.
    white_w_m2_sr : float
        Declared white.
    """
    n_slots, rows, cols = frames.shape
    return RadianceVideo(
        rows=rows,
        cols=cols,
        samples_per_pitch=samples_per_pitch,
        slot_s=slot_s,
        instants_per_slot=1,
        slots_per_segment=1,
        n_slots=n_slots,
        load=lambda slot: Segment(frames[slot], frames[slot], (), 1),
        white_w_m2_sr=white_w_m2_sr,
    )


def still(
    image: Floats, *, n_slots: int, slot_s: float, samples_per_pitch: int = 1, white_w_m2_sr: float = 1.0
) -> RadianceVideo:
    """Make a static radiance video.

    Parameters
    ----------
    image : ndarray of shape (y, x), float32
        Radiance, W m^-2 sr^-1.
    n_slots : int
        Slots.
    slot_s, samples_per_pitch, white_w_m2_sr
        As in :func:`footage`.
    """
    frames = np.broadcast_to(image, (n_slots, *image.shape))
    return footage(frames, slot_s=slot_s, samples_per_pitch=samples_per_pitch, white_w_m2_sr=white_w_m2_sr)
