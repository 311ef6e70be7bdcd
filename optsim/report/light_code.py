"""Luminance in 16 bits for the viewer of a report: logarithmic, exposable by many stops, read by a browser.

A page opened from disk may not read the pixels of an image file, so each video is a script with one string:
base64 of a zlib stream. The viewer (``template/viewer_data.js``) undoes :func:`pack`.
"""

from __future__ import annotations

import base64
import zlib

import numpy as np

from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Words

STEPS_PER_STOP = 256
"""Finest step: 1/256 stop, so light is off by at most 0.14 %."""
_ABOVE_E = 8.0
# 128 stops; differences of two codes keep to 16 bits with their sign.
_MOST = 32767


def floor_of(e_cd_m2: float) -> float:
    """Luminance at which the scale changes from linear to logarithmic, well below a metric's offset."""
    return e_cd_m2 / _ABOVE_E


def encode(luminance_cd_m2: Floats, floor_cd_m2: float) -> Words:
    """Round to steps: ``STEPS_PER_STOP * log2(1 + L / floor)``; light below zero counts as none."""
    stops = np.log2(1 + np.maximum(luminance_cd_m2, 0) / np.float32(floor_cd_m2))
    return np.rint(np.minimum(stops * STEPS_PER_STOP, _MOST)).astype(np.uint16)


def decode(codes: Words, floor_cd_m2: float, steps_per_stop: int = STEPS_PER_STOP) -> Doubles:
    """Luminance of codes, cd/m^2, as the viewer computes it."""
    return floor_cd_m2 * np.expm1(codes.astype(np.float64) * (np.log(2) / steps_per_stop))


def largest_error(steps_per_stop: int) -> float:
    """Largest error of the encoding, as a share of luminance plus floor; coarser steps round twice."""
    again = 0.5 / STEPS_PER_STOP if steps_per_stop < STEPS_PER_STOP else 0.0
    return float(2 ** (0.5 / steps_per_stop + again) - 1)


def coarser(codes: Words, steps_per_stop: int) -> Words:
    """Round codes of the finest step to coarser steps."""
    by = STEPS_PER_STOP // steps_per_stop
    return ((codes.astype(np.uint32) + by // 2) // by).astype(np.uint16)


def pack(codes: Words, marks: Bytes, levels: Bytes | None) -> str:
    """Pack a video of one coded frame as text."""
    steps = np.diff(codes.astype(np.int32), axis=0, prepend=0)
    steps = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype(np.uint16)
    parts = [(steps & 255).astype(np.uint8), (steps >> 8).astype(np.uint8), marks]
    if levels is not None:
        parts.append(levels ^ np.concatenate([np.zeros_like(levels[:1]), levels[:-1]]))
    stream = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    return base64.b64encode(zlib.compress(stream, 6)).decode("ascii")


def marks_of(valid: Bools, moving: Bools) -> Bytes:
    """One byte a panel pixel: bit 0 where the estimate is valid, bit 1 where pixels are held moving."""
    return (valid.astype(np.uint8) + 2 * moving.astype(np.uint8)).astype(np.uint8)
