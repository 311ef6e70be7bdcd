"""Video from one coded image of a fluttered shutter: the blur of uniform motion is inverted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Literal

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import Crosstalk, nearest
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, CodedFrame, Doubles, Floats
from optsim.decoding.coded_blur import CodedBlur, Velocity, coded_blur, shifted, spectrum_of
from optsim.decoding.coded_images import CodedImage, coded_images, covered
from optsim.decoding.partial import Partial, PartialDecoder
from optsim.decoding.velocity_choice import explained

# Pixels whose weights differ from the common ones by less than this share have the same code: the panel's
# state after the frame before changes the first slots a little.
_ALIKE = 0.1
_LEAST = 1e-6


class MotionDeblurring(PartialDecoder):
    """Deconvolution along constant velocities, the natural decoder of one code for all pixels.

    R. Raskar, A. Agrawal and J. Tumblin, "Coded exposure photography: motion deblurring using fluttered
    shutter", ACM Trans. Graph. 25(3), 795 (SIGGRAPH 2006, doi:10.1145/1141911.1141957). Theirs is the linear
    system: the blur is the code laid out along the motion path. A code without a zero in its spectrum keeps
    it invertible. In theirs a user outlines the object and states its motion, as ``velocity_px`` does for the
    whole image.

    Ours is the rest. They solve a system of single rows; here it is regularised least squares with the
    predicted noise and unknown light beyond the border. Without ``velocity_px`` each neighbourhood gets the
    velocity whose sharp image looks most like a natural one (:mod:`~optsim.decoding.velocity_choice`). Each
    slot shows the sharp images shifted along their paths, the faster before the slower.

    It works with any code that all moving pixels share; with one long exposure the frequencies at its zeros
    stay lost. A neighbourhood has one velocity through the whole frame: no rotation, scaling or acceleration.
    Occlusion is not modelled: near the border of a moving object, over half the length of its blur, both
    sides are wrong. An object smaller than its own blur is seldom found.

    Parameters
    ----------
    velocity_px : tuple of two floats, optional
        Pixels a slot, down and to the right, of the whole image; by default it is estimated.
    max_speed_px, step_px : float
        Fastest velocity of the search and step of its grid, pixels a slot; accepted velocities are
        then refined to an eighth of the step.
    neighbourhood_px : int
        Side of the square over which the cost of a velocity is averaged.
    model_error : float
        Standard deviation of the model error relative to the light; it counts as noise.
    rounds : int
        Steps of the conjugate gradients for each velocity chosen.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.

    Notes
    -----
    The defaults from ``step_px`` on were chosen on synthetic films of single velocities and of moving discs,
    at
    36 slots (no source).
    """

    kind: Literal["motion_deblurring"] = "motion_deblurring"
    velocity_px: tuple[float, float] | None = None
    max_speed_px: float = Field(default=1.5, gt=0, le=10)
    step_px: float = Field(default=0.125, gt=0, le=1)
    neighbourhood_px: int = Field(default=15, ge=1, le=200)
    model_error: float = Field(default=0.03, ge=0, le=1)
    rounds: int = Field(default=60, ge=0, le=1000)
    crosstalk: Crosstalk = "undone"

    def partials(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Partial]:
        """Decode as :meth:`decode`, as partial reconstructions.

        Raises
        ------
        ConfigError
            When fewer than half of the moving pixels have the same code.
        """
        for frame, image in coded_images(frames, calibration, self.crosstalk):
            known = image.usable & (image.exposure > _LEAST)
            moving = frame.code.moving & (frame.code.moving & known).any()
            light = np.zeros_like(image.weights)
            if moving.any():
                code, alike = shared_code(image.weights[:, :, : calibration.coded_slots], moving & known)
                found = self._video(image, known, code, alike)
                light = np.ascontiguousarray(np.moveaxis(found, 0, -1)) * moving[:, :, None]
            count = moving.astype(np.float32)
            yield covered(frame, image, light, count, np.ones_like(count))

    def _video(self, image: CodedImage, known: Bools, code: Doubles, alike: Bools) -> Floats:
        """Light of all slots, (slot, v, u), for static pixels too."""
        slots = image.weights.shape[2]
        opened = np.maximum(image.exposure, np.float32(_LEAST))
        light = image.signal / opened
        mean = float(light[alike].mean(dtype=np.float64))
        if mean <= 0:
            return np.zeros((slots, *light.shape), np.float32)
        if not known.all():
            light = light[nearest(known)]
        light = (light / np.float32(mean)).astype(np.float32)
        # A saturated pixel is only bounded from below: its standard deviation is its own value.
        variance = image.variance / (opened * np.float32(mean)) ** 2 + np.where(image.saturated, light**2, 0)
        margin = self._margin(len(code), slots)
        blur = coded_blur(light, variance.astype(np.float32), alike, code, margin, self.model_error)
        video = painted(blur, *self._explained(blur, light.shape), slots, light.shape)
        return video * np.float32(mean)

    def _explained(self, blur: CodedBlur, shape: tuple[int, ...]) -> tuple[list[Velocity], Floats, Floats]:
        """Velocities in the order of occlusion, their masks and sharp images."""
        if self.velocity_px is None:
            grid = (self.max_speed_px, self.step_px)
            return explained(blur, shape, grid, self.neighbourhood_px, self.rounds)
        picture = blur.restored(blur.along(self.velocity_px), self.rounds)
        return [self.velocity_px], np.ones((1, *blur.light.shape), np.float32), picture[None]

    def _margin(self, coded_slots: int, slots: int) -> int:
        """Margin of pixels from which light may enter the image, or to which it may leave."""
        fastest = self.max_speed_px + self.step_px
        if self.velocity_px is not None:
            fastest = math.hypot(*self.velocity_px)
        middle = (coded_slots - 1) / 2
        return math.ceil(fastest * max(middle, slots - 1 - middle)) + 1


def shared_code(weights: Floats, moving: Bools) -> tuple[Doubles, Bools]:
    """Weights that most moving pixels have, (slot,), and which pixels have them, (v, u)."""
    code = np.median(weights[moving], axis=0).astype(np.float64)
    apart = np.abs(weights - code.astype(np.float32)).sum(axis=2)
    alike = moving & (apart <= _ALIKE * code.sum())
    share = np.count_nonzero(alike) / np.count_nonzero(moving)
    if share < 0.5 or not code.any():
        raise ConfigError(
            f"decoder.kind: got motion_deblurring for a code that {100 * share:.0f} % of the moving pixels "
            "share, expected one for at least half of them; take scheme.kind=flutter_shutter, or a decoder "
            "for codes that differ from pixel to pixel, such as total_variation"
        )
    return code, alike


def painted(
    blur: CodedBlur,
    velocities: list[Velocity],
    masks: Floats,
    pictures: Floats,
    slots: int,
    shape: tuple[int, ...],
) -> Floats:
    """Shift sharp images along their motion paths, each over those before it: (slot, v, u), float32."""
    inside = tuple(slice(blur.margin, blur.margin + n) for n in shape)
    light = np.zeros((slots, *shape), np.float32)
    for place, velocity in enumerate(velocities):
        spectra = [spectrum_of(each[place]) for each in (pictures, masks)]
        for slot in range(slots):
            late = slot - blur.middle
            there, mask = shifted(spectra, blur.light.shape, (late * velocity[0], late * velocity[1]))
            blend_weight = np.clip(mask[inside], 0, 1) if place else np.float32(1)
            light[slot] += blend_weight * (there[inside] - light[slot])
    return light
