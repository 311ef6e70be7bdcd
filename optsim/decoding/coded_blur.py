# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Model and inversion of the blur of uniform motion under one code for all pixels.

The unknown is a slot's mean light, shifted by a constant velocity from slot to slot. The coded image is then
exactly its convolution with the code's weights along the motion path. Light is relative to its mean and the
code's weights sum to 1, so uniform light keeps its value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats

Spectrum = NDArray[np.complex64]
Velocity = tuple[float, float]

# Share of the light's power; below it a spectrum is float32's own noise.
_LEAST = 1e-7


@dataclass(frozen=True, eq=False)
class VelocityBlur:
    """A velocity's blur; spectra (rows, cols // 2 + 1)."""

    transfer: Spectrum  # Transfer function of the code along the motion path.
    noise: Floats  # Noise power over signal power.
    power: Floats  # Squared magnitude of the transfer function, plus ``noise``.
    rough: float  # Standard deviation that noise alone gives the gradients of the equalised sharp image.


@dataclass(frozen=True, eq=False)
class CodedBlur:
    """A coded image on a canvas, with a margin from which unknown light moves in."""

    light: Floats  # (rows, cols), mean light while open; a guess where it isn't measured.
    # (rows, cols), inverse noise variance over that of a typical pixel; 0 without a measurement.
    certainty: Floats
    variance: float  # Noise variance of a typical pixel.
    error: float  # Variance of the model error where something moves.
    code: Floats  # Weights of the coded slots, sum 1. The sharp image is placed where it is at their middle.
    margin: int  # Pixels above and to the left of the image.
    spectrum: Spectrum  # (rows, cols // 2 + 1), of ``light``.
    slope: Floats  # (rows, cols // 2 + 1), squared magnitude of the gradient's transfer function.

    @property
    def middle(self) -> float:
        """Slot, counted from 0, at which the sharp image is placed."""
        return (len(self.code) - 1) / 2

    def along(self, velocity: Velocity) -> VelocityBlur:
        """Blur of a velocity, in pixels a slot, and its noise."""
        shape = self.light.shape
        transfer = np.empty(self.spectrum.shape, np.complex64)
        back = (-self.middle * velocity[0], -self.middle * velocity[1])
        _horner(self.code, *_phases(shape, velocity), *_phases(shape, back), transfer)
        passed = np.abs(transfer) ** 2
        # A static scene occludes nothing, so the model error applies to moving ones only.
        moved = min(1.0, math.hypot(*velocity) * len(self.code))
        variance = max(self.variance + self.error * moved**2, _LEAST)
        # Half of the frequencies stand for the other half; both sums lack the same ones, and the mean light.
        seen = np.abs(self.spectrum) ** 2
        per_gradient = passed / np.maximum(self.slope, _LEAST)
        seen[0, 0] = per_gradient[0, 0] = 0
        there = float(seen.mean(dtype=np.float64)) / self.light.size - variance
        # Image power falls as the inverse square of frequency (D. J. Field, J. Opt. Soc. Am. A 4,
        # 2379 (1987)): gradient power is the same at all frequencies, and the coded image gives it.
        gradient = max(there, _LEAST) / float(per_gradient.mean(dtype=np.float64))
        noise = self.slope * np.float32(variance / gradient)
        power = passed + noise
        # The slope is the sum over both gradients.
        rough = math.sqrt(self.variance * float((self.slope / power).mean(dtype=np.float64)) / 2)
        return VelocityBlur(transfer, noise, power, rough)

    def wiener(self, along: VelocityBlur) -> Floats:
        """Sharp image in closed form, (rows, cols); all pixels count as measured with equal noise."""
        found = np.conj(along.transfer) * self.spectrum / along.power
        return _picture(found.astype(np.complex64, copy=False), self.light.shape)

    def equalised(self, picture: Floats, along: VelocityBlur) -> Floats:
        """Sharp image with its expected power: blurring by the regularisation must not lower a cost."""
        # Power spectrum equalisation, the geometric mean of inverse and Wiener filter (T. M. Cannon, IEEE
        # Trans. Acoust. Speech Signal Process. 24, 58 (1976), doi:10.1109/TASSP.1976.1162770).
        lost = np.sqrt(along.power / np.maximum(along.power - along.noise, _LEAST))
        equal = (spectrum_of(picture) * lost).astype(np.complex64, copy=False)
        return _picture(equal, self.light.shape)

    def restored(self, along: VelocityBlur, rounds: int) -> Floats:
        """Sharp image (rows, cols) that fits the measured pixels best, each weighted by its own noise."""
        shape = self.light.shape
        adjoint, inverse = np.conj(along.transfer), 1 / along.power

        def normal(spectrum: Spectrum) -> Spectrum:
            seen = self.certainty * _picture(along.transfer * spectrum, shape)
            return (adjoint * spectrum_of(seen) + along.noise * spectrum).astype(np.complex64, copy=False)

        found = (adjoint * self.spectrum * inverse).astype(np.complex64, copy=False)
        left = adjoint * spectrum_of(self.certainty * self.light) - normal(found)
        ahead = (inverse * left).astype(np.complex64, copy=False)
        size = start = _inner(left, ahead, shape)
        # Conjugate gradients on the normal equations, preconditioned by the closed form.
        for _ in range(rounds):
            # Float32 allows no smaller residual.
            if size <= _LEAST * start:
                break
            moved = normal(ahead)
            step = np.complex64(size / _inner(ahead, moved, shape))
            found += step * ahead
            left -= step * moved
            better = (inverse * left).astype(np.complex64, copy=False)
            size, before = _inner(left, better, shape), size
            ahead = (better + np.complex64(size / before) * ahead).astype(np.complex64, copy=False)
        return _picture(found, shape)


def coded_blur(
    light: Floats, variance: Floats, known: Bools, code: Doubles, margin: int, model_error: float
) -> CodedBlur:
    """Place a coded image on a canvas."""
    rows, cols = (cast("int", fft.next_fast_len(n + 2 * margin, real=True)) for n in light.shape)
    sides = [(margin, n - side - margin) for n, side in zip((rows, cols), light.shape, strict=True)]
    typical = float(np.median(variance[known]))
    total = variance + (np.float32(model_error) * light) ** 2
    certainty = np.where(known, (typical + model_error**2) / np.maximum(total, _LEAST), 0)
    canvas = np.pad(light, sides, mode="symmetric").astype(np.float32)
    v, u = 2 * np.pi * np.fft.fftfreq(rows), 2 * np.pi * np.fft.rfftfreq(cols)
    slope = 4 - 2 * np.cos(v)[:, None] - 2 * np.cos(u)
    return CodedBlur(
        canvas,
        np.pad(certainty, sides).astype(np.float32),
        typical,
        model_error**2,
        (code / code.sum()).astype(np.float32),
        margin,
        spectrum_of(canvas),
        slope.astype(np.float32),
    )


def shifted(pictures: list[Spectrum], shape: tuple[int, ...], displacement: Velocity) -> list[Floats]:
    """Images of these spectra, shifted by pixels (dv, du), whole or not, round the canvas: (rows, cols)."""
    along_v, along_u = _phases(shape, displacement)
    return [_picture(each * along_v[:, None] * along_u, shape) for each in pictures]


def _phases(shape: tuple[int, ...], displacement: Velocity) -> tuple[Spectrum, Spectrum]:
    """Transfer function of a shift, as factors of rows and columns of frequencies."""
    return (
        np.exp(-2j * np.pi * np.fft.fftfreq(shape[0]) * displacement[0]).astype(np.complex64),
        np.exp(-2j * np.pi * np.fft.rfftfreq(shape[1]) * displacement[1]).astype(np.complex64),
    )


def spectrum_of(picture: Floats) -> Spectrum:
    """Spectrum of a real image: (rows, cols // 2 + 1)."""
    return cast("Spectrum", fft.rfft2(picture))


def _picture(spectrum: Spectrum, shape: tuple[int, ...]) -> Floats:
    return cast("Floats", fft.irfft2(spectrum, s=shape))


def _inner(a: Spectrum, b: Spectrum, shape: tuple[int, ...]) -> float:
    """Inner product up to a factor: columns count twice, except those that are their own mirror."""
    single = [0] if shape[1] % 2 else [0, -1]
    return float((2 * np.vdot(a, b) - np.vdot(a[:, single], b[:, single])).real)


@compiled(fastmath={"reassoc", "contract", "nsz"})
def _horner(
    code: Floats, turn_v: Spectrum, turn_u: Spectrum, back_v: Spectrum, back_u: Spectrum, out: Spectrum
) -> None:
    """Sum over slots of weight times phase, by Horner's rule, at each frequency."""
    for i in range(turn_v.size):
        for j in range(turn_u.size):
            turn = turn_v[i] * turn_u[j]
            total = np.complex64(0)
            for t in range(code.size - 1, -1, -1):
                total = total * turn + code[t]
            out[i, j] = total * back_v[i] * back_u[j]
