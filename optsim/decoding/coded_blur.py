# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""A picture that moves evenly while one code for all pixels opens and closes, and how to undo its blur.

What is looked for is a slot's mean light, carried along by a constant velocity from slot to slot: the coded
image is then exactly its convolution with the code's weights, laid out along the way. Light is relative to
its mean and the code's weights sum to 1, so that even light keeps its value.
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

# Of the light's power; below it a spectrum is float32's own noise.
_LEAST = 1e-7


@dataclass(frozen=True, eq=False)
class Way:
    """A velocity's blur.

    Parameters
    ----------
    transfer : ndarray of shape (rows, cols // 2 + 1), complex64
        Transfer function of the code along the way.
    noise : ndarray of shape (rows, cols // 2 + 1), float32
        Noise power over that of the picture.
    power : ndarray of shape (rows, cols // 2 + 1), float32
        Squared magnitude of the transfer function, plus ``noise``.
    rough : float
        Standard deviation that noise alone gives the gradients of the equalised sharp picture.
    """

    transfer: Spectrum
    noise: Floats
    power: Floats
    rough: float


@dataclass(frozen=True, eq=False)
class CodedBlur:
    """A coded image on a canvas with a margin, which unknown light moves in from.

    Parameters
    ----------
    light : ndarray of shape (rows, cols), float32
        Mean light while open; a guess where it isn't known.
    certainty : ndarray of shape (rows, cols), float32
        Inverse of its noise variance, relative to that of a typical pixel; 0 where it isn't known.
    variance, error : float
        Noise variance of a typical pixel, and that of what the model misses where something moves.
    code : ndarray of shape (slot,), float32
        Weights of the coded slots, sum 1. The sharp picture is where it is drawn at their middle.
    margin : int
        Pixels above and to the left of the image.
    spectrum : ndarray of shape (rows, cols // 2 + 1), complex64
        Of ``light``.
    slope : ndarray of shape (rows, cols // 2 + 1), float32
        Squared magnitude of the gradient's own transfer function.
    """

    light: Floats
    certainty: Floats
    variance: float
    error: float
    code: Floats
    margin: int
    spectrum: Spectrum
    slope: Floats

    @property
    def middle(self) -> float:
        """Slot, counted from 0, of the sharp picture."""
        return (len(self.code) - 1) / 2

    def along(self, velocity: Velocity) -> Way:
        """Blur of a velocity, in pixels a slot, and how much noise there is in it.

        A picture's power is taken to fall as the inverse square of frequency (D. J. Field, J. Opt. Soc. Am. A
        4, 2379 (1987)): its gradient's is the same at all. How much there is, the coded image's own says.
        """
        shape = self.light.shape
        transfer = np.empty(self.spectrum.shape, np.complex64)
        back = (-self.middle * velocity[0], -self.middle * velocity[1])
        _horner(self.code, *_phases(shape, velocity), *_phases(shape, back), transfer)
        passed = np.abs(transfer) ** 2
        # What stands still hides nothing and has no way to be wrong about.
        moved = min(1.0, math.hypot(*velocity) * len(self.code))
        variance = max(self.variance + self.error * moved**2, _LEAST)
        # Half of the frequencies stand for the other half; both sums lack the same ones, and the mean light.
        seen = np.abs(self.spectrum) ** 2
        per_gradient = passed / np.maximum(self.slope, _LEAST)
        seen[0, 0] = per_gradient[0, 0] = 0
        there = float(seen.mean(dtype=np.float64)) / self.light.size - variance
        gradient = max(there, _LEAST) / float(per_gradient.mean(dtype=np.float64))
        noise = self.slope * np.float32(variance / gradient)
        power = passed + noise
        # The slope is that of both gradients.
        rough = math.sqrt(self.variance * float((self.slope / power).mean(dtype=np.float64)) / 2)
        return Way(transfer, noise, power, rough)

    def wiener(self, way: Way) -> Floats:
        """Sharp picture in closed form, all pixels taken as known alike: (rows, cols)."""
        found = np.conj(way.transfer) * self.spectrum / way.power
        return _picture(found.astype(np.complex64, copy=False), self.light.shape)

    def equalised(self, picture: Floats, way: Way) -> Floats:
        """Sharp picture with the power that it is expected to have: what regularisation smoothed is no merit.

        Power spectrum equalisation, the geometric mean of inverse and Wiener filter (T. M. Cannon, IEEE
        Trans. Acoust. Speech Signal Process. 24, 58 (1976), doi:10.1109/TASSP.1976.1162770).
        """
        lost = np.sqrt(way.power / np.maximum(way.power - way.noise, _LEAST))
        equal = (spectrum_of(picture) * lost).astype(np.complex64, copy=False)
        return _picture(equal, self.light.shape)

    def restored(self, way: Way, rounds: int) -> Floats:
        """Sharp picture that explains the known pixels best, each by its own noise: (rows, cols).

        So many steps of conjugate gradients on the normal equations of the same regularised least squares,
        from the closed form and with it as the preconditioner.
        """
        shape = self.light.shape
        adjoint, inverse = np.conj(way.transfer), 1 / way.power

        def normal(spectrum: Spectrum) -> Spectrum:
            seen = self.certainty * _picture(way.transfer * spectrum, shape)
            return (adjoint * spectrum_of(seen) + way.noise * spectrum).astype(np.complex64, copy=False)

        found = (adjoint * self.spectrum * inverse).astype(np.complex64, copy=False)
        left = adjoint * spectrum_of(self.certainty * self.light) - normal(found)
        ahead = (inverse * left).astype(np.complex64, copy=False)
        size = start = _inner(left, ahead, shape)
        for _ in range(rounds):
            # Float32 gets no nearer.
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
    """Lay a coded image on a canvas.

    Parameters
    ----------
    light : ndarray of shape (v, u), float32
        Mean light while open, relative to its mean; a guess where it isn't known.
    variance : ndarray of shape (v, u), float32
        Of its noise.
    known : ndarray of shape (v, u), bool
        Where it is known, somewhere at least.
    code : ndarray of shape (slot,)
        Weights of the coded slots.
    margin : int
        Pixels at least on each side, for what moves in.
    model_error : float
        Standard deviation of what the model misses, relative to the light.
    """
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


def carried(pictures: list[Spectrum], shape: tuple[int, ...], way: Velocity) -> list[Floats]:
    """Pictures of these spectra, moved by pixels (dv, du), whole or not, round the canvas: (rows, cols)."""
    along_v, along_u = _phases(shape, way)
    return [_picture(each * along_v[:, None] * along_u, shape) for each in pictures]


def _phases(shape: tuple[int, ...], way: Velocity) -> tuple[Spectrum, Spectrum]:
    """Transfer function of a way, as factors of rows and columns of frequencies."""
    return (
        np.exp(-2j * np.pi * np.fft.fftfreq(shape[0]) * way[0]).astype(np.complex64),
        np.exp(-2j * np.pi * np.fft.rfftfreq(shape[1]) * way[1]).astype(np.complex64),
    )


def spectrum_of(picture: Floats) -> Spectrum:
    """Of a real picture: (rows, cols // 2 + 1)."""
    return cast("Spectrum", fft.rfft2(picture))


def _picture(spectrum: Spectrum, shape: tuple[int, ...]) -> Floats:
    return cast("Floats", fft.irfft2(spectrum, s=shape))


def _inner(a: Spectrum, b: Spectrum, shape: tuple[int, ...]) -> float:
    """Inner product but for a factor: all columns but those that are their own mirror count twice."""
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
