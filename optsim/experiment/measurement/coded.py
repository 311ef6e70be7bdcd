"""Coded images of any camera with their codes, converted to the decoders' frames and calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from optsim.calibration import Calibration
from optsim.core.config import Part
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Bytes, CodedFrame, Doubles, ExposureCode, Floats, Words
from optsim.optics.panel import PanelResponse

# An instantaneous panel without leak, whose weight is the sine squared of a quarter turn times its level.
_OPEN_OR_SHUT = PanelResponse(tau_on_s=0, tau_off_s=0, leak=0, drive_exponent=1.0)
_WORDS = 65535
# Percentile of bright counts, and least steps there; coarser steps are refused if coarser than the noise,
# too.
_BRIGHT, _STEPS = 90, 1000
# Ratio of truth to image, or the reverse, beyond which the truth is in another unit.
_TIMES = 3.0


class Sensor(Part):
    """The sensor of coded images, in the counts of their files.

    Parameters
    ----------
    black : float
        Counts without light.
    saturation : float or None
        Least saturated count. None for the largest number of 8 or 16 bits in whole-number files,
        and no saturation in others.
    read_noise : float or None
        Temporal noise in the dark, quantisation included, counts. None for 1 (no source), or for the noise
        of 8 bits where an image of fractional numbers, 0 to 1 for example, stays below 255.
    counts_per_electron : float
        System gain; 0 leaves shot noise out.
    slot_s : float
        Duration of a slot, s; decoders don't depend on it.
    """

    black: float = Field(default=0.0, allow_inf_nan=False)
    saturation: float | None = Field(default=None, allow_inf_nan=False)
    read_noise: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    counts_per_electron: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    slot_s: float = Field(default=1.0, gt=0, allow_inf_nan=False)

    @model_validator(mode="after")
    def _light_between(self) -> Sensor:
        if self.saturation is not None and self.saturation <= self.black:
            raise ValueError(
                f"saturation: got {self.saturation:g}, expected more than black, {self.black:g}: there is "
                "no light between them"
            )
        return self


@dataclass(frozen=True, eq=False)
class Measurement:
    """Coded frames with the calibration of their camera.

    Parameters
    ----------
    frames : tuple of CodedFrame
        Images with their codes, in order of time.
    calibration : Calibration
        Calibration of the camera.
    truth : tuple of ndarray of shape (slot, v, u), float32
        The same light slot by slot, a frame each, in the unit of ``unit``; empty when unknown.
    unit : str
        Unit of the light: counts a slot where the camera isn't calibrated.
    rounded : float
        Largest rounding of the code's weights: 0 for pixels that are open or shut.
    origin : Mapping
        Provenance for the records of its decoding: files and their SHA-256, settings, or a run.
    """

    frames: tuple[CodedFrame, ...]
    calibration: Calibration
    truth: tuple[Floats, ...]
    unit: str
    rounded: float
    origin: Mapping[str, object] = field(default_factory=dict[str, object])

    def __post_init__(self) -> None:
        if self.truth and len(self.truth) != len(self.frames):
            raise ValueCheckError(
                f"truth: got {len(self.truth)} frames, expected {len(self.frames)}, one a coded image"
            )
        want = (self.calibration.slots_per_frame, *self.calibration.shape)
        for each in self.truth:
            if each.shape != want:
                raise ValueCheckError(f"truth: got {each.shape} a coded image, expected {want}: (slot, v, u)")


def coded_measurement(
    images: NDArray[Any],
    codes: NDArray[Any],
    *,
    sensor: Sensor | None = None,
    moving: NDArray[Any] | None = None,
    truth: NDArray[Any] | None = None,
) -> Measurement:
    """Make a measurement from arrays: each pixel of an image is the sum over slots of weight times light.

    Parameters
    ----------
    images : ndarray of shape (v, u) or (frame, v, u)
        Counts, whole or not; non-finite values mark dead pixels.
    codes : ndarray of shape (slot, v, u) or (frame, slot, v, u)
        Weights from 0 to 1, or whole numbers of 8 bits from 0 to 255; one for all frames, or one each.
    sensor : Sensor, optional
        The sensor.
    moving : ndarray of shape (v, u) or (frame, v, u), optional
        Not zero: pixels of the video decoder, where a decoder distinguishes; default all.
    truth : ndarray of shape (slot, v, u) or (frame, slot, v, u) or (frame * slot, v, u), optional
        Light in each slot, counts.

    Returns
    -------
    Measurement
        The measurement, with light in counts a slot.

    Raises
    ------
    ValueCheckError
        For shapes that don't agree, weights outside of 0..1, non-finite light, or light in another unit than
        the image. Also for a black level above the whole image, and for a few pixels so bright that 16 bits
        leave too few steps for the others.
    """
    known = sensor or Sensor()
    images, codes = stacked(images, codes)
    if images.shape[1:] != codes.shape[2:]:
        raise ValueCheckError(
            f"images of {images.shape[1:]} and codes of {codes.shape[2:]} pixels: expected codes of the "
            f"images' pixels, (slot, v, u); {_other_pixels(images, codes)}"
        )
    levels, rounded = code_levels(codes)
    full, noise = _full(images, known), _read_noise(images, known)
    _check_light(images, known.black, noise)
    light = truth_frames(truth, len(images), levels.shape[1])
    _check_unit(light, images, levels, known.black, full, noise)
    words, scale = _words(images, known.black, full, noise)
    alive: Bools = np.asarray(np.isfinite(images).all(axis=0))
    return Measurement(
        coded_frames(words, levels, moving_masks(moving, len(images), images.shape[1:])),
        _calibration(levels, alive, known, noise, scale, full),
        light,
        "counts a slot",
        rounded,
        {"sensor": known.model_dump(mode="json")},
    )


def _other_pixels(images: NDArray[Any], codes: NDArray[Any]) -> str:
    """Cure where images (frame, y, x) and codes (frame, slot, v, u) differ in their pixels."""
    if codes.shape[1:3] == images.shape[1:]:
        return "the slots come last: np.moveaxis(code, -1, -3) puts them before the pixels"
    if images.shape[2] in (3, 4) and images.shape[:2] == codes.shape[2:]:
        return "the image has colours: give one of them, or their mean"
    return "images of a sensor with other pixels need a calibration (key 'bench')"


def numbers(name: str, given: object) -> NDArray[Any]:
    """Convert to an array of real numbers."""
    try:
        found = np.asarray(given)
    except ValueError as error:
        raise ValueCheckError(f"{name}: {error}; expected one array of numbers") from None
    if found.dtype.kind not in "biuf":
        cure = "take one part of it" if found.dtype.kind == "c" else "convert it"
        raise ValueCheckError(f"{name}: got {found.dtype}, expected real numbers; {cure}")
    return found


def stacked(images: object, codes: object) -> tuple[NDArray[Any], NDArray[Any]]:
    """Stack images (frame, y, x), and codes (frame, slot, v, u): one for all or one each."""
    images, codes = numbers("image", images), numbers("code", codes)
    images = images[None] if images.ndim == 2 else images
    codes = codes[None] if codes.ndim == 3 else codes
    if images.ndim != 3 or codes.ndim != 4 or not images.size or not codes.size:
        raise ValueCheckError(
            f"image {images.shape}, code {codes.shape}: expected (v, u) or (frame, v, u), and "
            "(slot, v, u) or (frame, slot, v, u), none of them empty"
        )
    if len(codes) not in (1, len(images)):
        raise ValueCheckError(
            f"{len(images)} images of {images.shape[1:]} and {len(codes)} codes of {codes.shape[2:]} pixels: "
            "expected one code for all images or one each"
        )
    return images, codes


def coded_frames(words: list[Words], levels: Bytes, moving: Bools) -> tuple[CodedFrame, ...]:
    """Join images with their codes and masks, of which there is one for all or one each."""
    return tuple(
        CodedFrame(k, word, ExposureCode(levels[k % len(levels)], moving[k % len(moving)]))
        for k, word in enumerate(words)
    )


def moving_masks(moving: NDArray[Any] | None, n_frames: int, shape: tuple[int, ...]) -> Bools:
    """Read masks of moving pixels, (1 or frame, v, u); all pixels by default."""
    if moving is None:
        return np.ones((1, *shape), np.bool_)
    found = numbers("moving", moving)
    masks: Bools = (found[None] if found.ndim == 2 else found) != 0
    if masks.ndim != 3 or masks.shape[1:] != shape or len(masks) not in (1, n_frames):
        raise ValueCheckError(
            f"moving: got {found.shape}, expected one mask of {shape} pixels, those of the code, or "
            f"{n_frames} of them, one a coded image"
        )
    return masks


def code_levels(codes: NDArray[Any]) -> tuple[Bytes, float]:
    """Drive levels of an instantaneous panel for a code's weights, and their rounding error."""
    least, most = float(codes.min(initial=0)), float(codes.max(initial=0))
    whole = codes.dtype == np.uint8 and most > 1
    if not (least >= 0 and (most <= 1 or whole)):
        raise ValueCheckError(
            f"code: got values from {least:g} to {most:g} of {codes.dtype}, expected weights from 0 to 1, or "
            "whole numbers of 8 bits up to 255; cure: divide by what fully open is"
        )
    weights = codes.astype(np.float64) / (255 if whole else 1)
    levels = np.rint(255 * np.arcsin(np.sqrt(weights)) / (np.pi / 2)).astype(np.uint8)
    return levels, float(np.abs(_weights(levels) - weights).max(initial=0))


def _weights(levels: Bytes) -> Doubles:
    """Weights of an instantaneous panel's drive levels."""
    return np.sin(levels / 255 * np.pi / 2) ** 2


def truth_frames(truth: NDArray[Any] | None, n_frames: int, slots: int) -> tuple[Floats, ...]:
    """Light a coded image, (slot, v, u) each; whole frames only."""
    if truth is None:
        return ()
    found = numbers("truth", truth)
    fits = found.ndim == 4 and found.shape[:2] == (n_frames, slots)
    fits |= found.ndim == 3 and len(found) >= n_frames * slots
    if not fits:
        raise ValueCheckError(
            f"truth: got {found.shape}, expected {n_frames} x {slots} pictures: all slots of each coded image"
        )
    stack = found.reshape(-1, *found.shape[-2:]).astype(np.float32)
    if not np.isfinite(stack).all():
        raise ValueCheckError(
            f"truth: {int((~np.isfinite(stack)).sum())} of its numbers are not finite, expected light "
            "everywhere, as a score needs it; fill them, or leave truth out"
        )
    return tuple(np.split(stack[: n_frames * slots], n_frames))


def _check_light(images: NDArray[Any], black: float, noise: float) -> None:
    """Refuse a black level that lies above the brightest pixel or close to it."""
    most = float(np.where(np.isfinite(images), images, -np.inf).max())
    if np.isfinite(most) and most < black - 3 * noise:
        raise ValueCheckError(
            f"sensor.black: got {black:g}, but no count of the image is above {most:g}: expected the counts "
            "that the sensor gives without light; lower it"
        )


def _check_unit(
    truth: tuple[Floats, ...],
    images: NDArray[Any],
    levels: Bytes,
    black: float,
    full: float,
    noise: float,
) -> None:
    """Refuse a truth whose sum under the code is far from the images."""
    for k, light in enumerate(truth):
        if light.shape[1:] != images.shape[1:]:
            return  # what holds truth and image says so
        seen = np.isfinite(images[k]) & (images[k] < full)
        if not seen.any():
            continue
        # Slot by slot: all slots together would need more memory than everything else.
        slots = zip(levels[k % len(levels)], light, strict=True)
        coded = sum(float((_weights(level[seen]) * each[seen]).mean()) for level, each in slots)
        counts = float(images[k][seen].mean()) - black
        if abs(coded - counts) > max(coded, counts) * (1 - 1 / _TIMES) + 3 * noise:
            raise ValueCheckError(
                f"truth: under the code it adds up to {coded:.3g} a pixel, the image has {counts:.3g} above "
                f"black ({black:g}): expected light in the image's unit, counts a slot; scale it, say "
                "sensor.black, or sensor.saturation if the image is clipped, or leave truth out"
            )


def _full(images: NDArray[Any], sensor: Sensor) -> float:
    """Least saturated count; infinite where none is stated."""
    if sensor.saturation is not None:
        return sensor.saturation
    return float(np.iinfo(images.dtype).max) if images.dtype.name in ("uint8", "uint16") else float("inf")


def _read_noise(images: NDArray[Any], sensor: Sensor) -> float:
    """Noise in the dark, counts, as stated, or by default at most that of 8 bits."""
    seen = images[np.isfinite(images)]
    if sensor.read_noise is not None:
        return sensor.read_noise
    if not seen.size or np.array_equal(seen, np.rint(seen)):
        return 1.0
    bright = float(np.percentile(np.abs(seen - sensor.black), _BRIGHT))
    return min(1.0, max(bright, 1e-30) / 255)


def _opened(levels: Bytes) -> int:
    """Slots until the last in which any pixel is open; the shutter is closed after it."""
    opened = np.flatnonzero(levels.any(axis=(0, 2, 3)))
    return int(opened[-1]) + 1 if opened.size else levels.shape[1]


def _words(
    images: NDArray[Any], black: float, full: float, noise: float
) -> tuple[list[Words], tuple[float, float]]:
    """Images in 16 bits, and their scale: first + step x count; ValueCheckError if that is too coarse."""
    finite = np.minimum(np.where(np.isfinite(images), images, black), full)
    least, most = float(finite.min(initial=black)), float(finite.max(initial=black))
    first, step = (0.0, 1.0)
    if least < 0 or most > _WORDS or not np.array_equal(finite, np.rint(finite)):
        # Noise below black stays noise, and rounding stays far below any sensor's resolution.
        first, step = least, max(most - least, 1e-30) / _WORDS
    bright = float(np.percentile(np.abs(finite - black), _BRIGHT))
    if step > max(2 * noise, bright / _STEPS):
        raise ValueCheckError(
            f"image: its numbers, {least:g} to {most:g}, are held in 16 bits, in steps of {step:g}, but "
            f"nine of ten are within {bright:g} of black; cure: sensor.saturation, from which on a number "
            "only says that it is too bright, or NaN for dead pixels"
        )
    return [np.rint((image - first) / step).astype(np.uint16) for image in finite], (first, step)


def _calibration(
    levels: Bytes, valid: Bools, sensor: Sensor, noise: float, scale: tuple[float, float], full: float
) -> Calibration:
    """Camera whose pixels are those of the code, as the paper's equations assume."""
    first, step = scale
    own = np.indices(valid.shape, dtype=np.int64)

    def even(count: float) -> Floats:
        return np.full(valid.shape, (count - first) / step, np.float32)

    return Calibration(
        source="ideal",
        slot_s=sensor.slot_s,
        slots_per_frame=levels.shape[1],
        coded_slots=_opened(levels),
        ccd_shape=(valid.shape[0], valid.shape[1]),
        response=_OPEN_OR_SHUT,
        centre_row=own[0],
        centre_col=own[1],
        valid=valid,
        responsivity_dn=np.full(valid.shape, 1 / step, np.float32),
        black_dn=even(sensor.black),
        saturation_dn=even(full) if np.isfinite(full) else np.full(valid.shape, 2.0 * _WORDS, np.float32),
        read_noise_dn=float(np.hypot(noise / step, 0.0 if step == 1 else 12**-0.5)),
        dn_per_e=sensor.counts_per_electron / step,
        crosstalk=np.ones((*valid.shape, 1, 1), np.float32),
        gain_uncertainty=0.0,
        leak_uncertainty=0.0,
        map_residual_px=0.0,
    )
