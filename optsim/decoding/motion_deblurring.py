"""Video from one coded image of a shutter that flutters: the blur of what moves evenly is undone."""

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
from optsim.decoding.coded_blur import CodedBlur, Velocity, carried, coded_blur, spectrum_of
from optsim.decoding.coded_images import CodedImage, coded_images, covered
from optsim.decoding.partial import Partial, PartialDecoder
from optsim.decoding.velocity_choice import explained

# Pixels whose weights differ from the common ones by less than this share have the same code: what the panel
# showed in the frame before changes the first slots a little.
_ALIKE = 0.1
_LEAST = 1e-6


class MotionDeblurring(PartialDecoder):
    """Deconvolution along constant velocities, the natural decoder of one code for all pixels.

    R. Raskar, A. Agrawal and J. Tumblin, "Coded exposure photography: motion deblurring using fluttered
    shutter", ACM Trans. Graph. 25(3), 795 (SIGGRAPH 2006, doi:10.1145/1141911.1141957). Theirs is the linear
    system: the blur is the code laid out along the way, and a code without a zero in its spectrum keeps it
    invertible. They let a user outline the object and say how it moves, as ``velocity_px`` does for the whole
    picture. Ours is the rest: regularised least squares with the noise that the calibration predicts and
    unknown light beyond the border, where they solve a system of single rows; and without ``velocity_px``
    the choice of a velocity for each neighbourhood, by which sharp picture looks most like a natural one
    (:mod:`~optsim.decoding.velocity_choice`). Each slot shows the sharp pictures carried along their ways,
    the faster before the slower.

    It takes any code that all moving pixels share; with one long exposure what its zeros lost stays lost.
    A neighbourhood has one velocity through the whole frame: no turn, no growth, no change of speed. What
    hides and uncovers what is a flaw of the model: near the border of a moving object, over half the length
    of its blur, both sides are wrong, and an object smaller than its own blur is seldom found.

    Parameters
    ----------
    velocity_px : tuple of two floats, optional
        Pixels a slot, down and to the right, of the whole picture; by default it is searched for.
    max_speed_px, step_px : float
        Fastest velocity of the search and step of its grid, pixels a slot; those that explain something are
        then refined to an eighth of the step.
    neighbourhood_px : int
        Side of the square over which the cost of a velocity is averaged.
    model_error : float
        What the model misses, as a standard deviation relative to the light: counts as noise.
    rounds : int
        Steps of the conjugate gradients for each velocity chosen.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.

    Notes
    -----
    The defaults from ``step_px`` on were chosen on made films of single velocities and of moving discs, at
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
        """As :meth:`decode`, as partial reconstructions.

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
        """Light of all slots, (slot, v, u), wherever pixels move or not."""
        slots = image.weights.shape[2]
        opened = np.maximum(image.exposure, np.float32(_LEAST))
        light = image.signal / opened
        mean = float(light[alike].mean(dtype=np.float64))
        if mean <= 0:
            return np.zeros((slots, *light.shape), np.float32)
        if not known.all():
            light = light[nearest(known)]
        light = (light / np.float32(mean)).astype(np.float32)
        # What saturates is only known to be so bright at least: it may be off by its own size.
        variance = image.variance / (opened * np.float32(mean)) ** 2 + np.where(image.saturated, light**2, 0)
        margin = self._margin(len(code), slots)
        blur = coded_blur(light, variance.astype(np.float32), alike, code, margin, self.model_error)
        video = painted(blur, *self._explained(blur, light.shape), slots, light.shape)
        return video * np.float32(mean)

    def _explained(self, blur: CodedBlur, shape: tuple[int, ...]) -> tuple[list[Velocity], Floats, Floats]:
        """Velocities in the order in which they hide each other, their masks and sharp pictures."""
        if self.velocity_px is None:
            grid = (self.max_speed_px, self.step_px)
            return explained(blur, shape, grid, self.neighbourhood_px, self.rounds)
        picture = blur.restored(blur.along(self.velocity_px), self.rounds)
        return [self.velocity_px], np.ones((1, *blur.light.shape), np.float32), picture[None]

    def _margin(self, coded_slots: int, slots: int) -> int:
        """Pixels that light comes from beyond the border, or goes to."""
        fastest = self.max_speed_px + self.step_px
        if self.velocity_px is not None:
            fastest = math.hypot(*self.velocity_px)
        middle = (coded_slots - 1) / 2
        return math.ceil(fastest * max(middle, slots - 1 - middle)) + 1


def shared_code(weights: Floats, moving: Bools) -> tuple[Doubles, Bools]:
    """Weights that most moving pixels have, (slot,), and which pixels have them, (v, u).

    Raises
    ------
    ConfigError
        When fewer than half of the moving pixels do.
    """
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
    """Carry sharp pictures along their ways, each painted over those before it: (slot, v, u), float32.

    Parameters
    ----------
    blur : CodedBlur
        The coded image.
    velocities : list of tuple
        Pixels a slot.
    masks, pictures : ndarray of shape (velocity, rows, cols), float32
        Where each is, at the middle of the code; the first is also where none of the others are.
    slots : int
        Slots of a frame.
    shape : tuple of int
        Of the image.
    """
    inside = tuple(slice(blur.margin, blur.margin + n) for n in shape)
    light = np.zeros((slots, *shape), np.float32)
    for place, velocity in enumerate(velocities):
        spectra = [spectrum_of(each[place]) for each in (pictures, masks)]
        for slot in range(slots):
            late = slot - blur.middle
            there, mask = carried(spectra, blur.light.shape, (late * velocity[0], late * velocity[1]))
            blend_weight = np.clip(mask[inside], 0, 1) if place else np.float32(1)
            light[slot] += blend_weight * (there[inside] - light[slot])
    return light
