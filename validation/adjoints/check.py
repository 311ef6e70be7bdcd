"""Every linear operator that has an adjoint against the definition of one, and against dense matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import demo
from optsim.core.quantities import Doubles
from optsim.decoding.coded_blur import coded_blur, spectrum_of
from optsim.decoding.tv_smoothing import smoothed
from optsim.experiment.signal_breakdown import light_paths
from optsim.optics.fringing import border_shares, fine_image, fine_image_adjoint

CLAIM = (
    "<A x, y> = <x, A' y> for the relay with blur, wings, overlap, ghost and veil at several alignments, its "
    "parts, fringing and the decoders' blur along a way; a pixel's traced paths bring what the frame has; "
    "total variation's step is the identity less a symmetric Laplacian"
)
ORACLE = (
    "inner products of random images; dense matrices column by column and row by row; shifts by full complex "
    "Fourier transforms, differences as dense matrices; numpy only"
)
SOURCE = (
    "definition of the adjoint; 'dot-product test', J. F. Claerbout, Earth Soundings Analysis (1992), ch. 5"
)
TOLERANCE = 1.0
REASON = "In units of what is allowed: 1e-10 of the norms in float64, 1e-6 in float32."
FILES = (
    "optsim/optics/*.py",
    "optsim/camera/parts/relay.py",
    "optsim/experiment/signal_breakdown.py",
    "optsim/decoding/coded_blur.py",
    "optsim/decoding/tv_smoothing.py",
)

_DOUBLE, _SINGLE = 1e-10, 1e-6
_ALIGNMENTS = (
    {},
    {"magnification": 2.88 * 4.54 / 20, "shift_y_px": 0.37, "shift_x_px": -0.81},
    {"rotation_rad": 4e-3, "keystone_y": 0.02, "keystone_x": -0.01, "distortion": -0.01, "ghost_share": 0.1},
)


def measure() -> float:
    """Find the largest deviation, in units of what is allowed."""
    return max(_all(broken=False), key=abs)


def perturbed() -> float:
    """Break each, return the least: blur its own adjoint, half a pixel, swaps, a turned way, wrapped rim."""
    return min(_all(broken=True), key=abs)


def _all(*, broken: bool) -> list[float]:
    relays = [_relay(_camera(40, 50, alignment), broken=broken) for alignment in _ALIGNMENTS]
    parts = _dense(broken=broken), _fringing(broken=broken), _along(broken=broken), _variation(broken=broken)
    return [*relays, *parts, *([] if broken else [_parts(), _traced()])]


def _camera(rows: int, cols: int, alignment: dict[str, float]) -> CodedCamera:
    camera = demo()
    relay = camera.relay.model_copy(update=alignment)
    sensor = camera.sensor.model_copy(update={"rows": 3 * rows + 7, "cols": 3 * cols + 4})
    return camera.model_copy(
        update={"relay": relay, "sensor": sensor, "panel_rows": rows, "panel_cols": cols}
    )


def _mismatch(
    apply: Callable[[Doubles], Doubles],
    adjoint: Callable[[Doubles], Doubles],
    shape: tuple[int, ...],
    allowed: float = _DOUBLE,
    dtype: type = np.float64,
) -> float:
    """Deviation of the two inner products, over the product of norms and what is allowed."""
    rng = np.random.default_rng(3)
    # Not of mean zero: veil and far wings would not show.
    x = rng.normal(0.5, 1, shape).astype(dtype)
    forth = apply(x).astype(np.float64)
    y = rng.normal(0.5, 1, forth.shape).astype(dtype)
    back = adjoint(y).astype(np.float64)
    difference = (forth * y).sum() - (x * back).sum()
    return float(difference / np.linalg.norm(forth) / np.linalg.norm(y) / allowed)


def _relay(camera: CodedCamera, *, broken: bool) -> float:
    operator = camera.relay_operator()
    shape, blur = (3 * camera.panel_rows, 3 * camera.panel_cols), operator.blur

    class _OwnAdjoint:
        shape, apply, adjoint = blur.shape, blur.apply, blur.apply

    other = replace(operator, blur=_OwnAdjoint()) if broken else operator
    exact = _mismatch(operator.apply, other.adjoint, shape)
    return max(exact, _mismatch(operator.apply, other.adjoint, shape, _SINGLE, np.float32), key=abs)


def _parts() -> float:
    operator = _camera(40, 50, _ALIGNMENTS[2]).relay_operator()
    overlap, blur, ghost = operator.overlap, operator.blur, operator.ghost
    found = [
        _mismatch(blur.apply, blur.adjoint, blur.shape),
        _mismatch(ghost.apply, ghost.apply, blur.shape),
        _mismatch(lambda x: overlap @ x, lambda y: overlap.T @ y, (overlap.shape[1],)),
    ]
    return max(found, key=abs)


def _dense(*, broken: bool) -> float:
    """Tiny camera: matrix by columns of the operator and by rows of its adjoint."""
    # Wrong: the way back is half a CCD pixel off.
    shifts = (0.37, 0.87 if broken else 0.37)
    operator, other = (
        _camera(4, 5, {**_ALIGNMENTS[1], "shift_y_px": shift}).relay_operator() for shift in shifts
    )
    columns = [operator.apply(each.reshape(12, 15)).ravel() for each in np.eye(12 * 15)]
    rows = [other.adjoint(each.reshape(19, 19)).ravel() for each in np.eye(19 * 19)]
    error = np.stack(columns, axis=1) - np.stack(rows)
    return float(error.ravel()[np.abs(error).argmax()] / np.abs(columns).max() / _DOUBLE)


def _fringing(*, broken: bool) -> float:
    borders = border_shares(0.2, 3)
    other = borders[:, ::-1] if broken else borders
    return _mismatch(lambda x: fine_image(x, borders), lambda y: fine_image_adjoint(y, other), (11, 14))


def _traced() -> float:
    """Electrons of one pixel, path by path: traced back from it, and by the whole frame's forward parts."""
    camera, at = _camera(40, 50, _ALIGNMENTS[2]), (51, 60)
    operator, glare, ghosts = camera.relay_operator(), camera.relay.glare_share, camera.relay.ghost_share
    energy = np.random.default_rng(5).uniform(0, 1e-6, (120, 150))
    direct = (1 - ghosts) * operator.project(operator.blur.apply(energy))
    ghost = ghosts * operator.project(operator.ghost.apply(energy))
    veil = glare * np.full_like(ghost, (direct + ghost).mean())
    paths = (1 - glare) * direct, (1 - glare) * ghost, veil
    expected = np.array([camera.photon_electrons(path)[at] for path in paths])
    found = (light_paths(camera, *at, 3) * energy).sum(axis=(1, 2))
    return float(max(found / expected - 1, key=abs) / _DOUBLE)


def _along(*, broken: bool) -> float:
    """Blur of a code along a way: ours, back, against shifts by Fourier's theorem, forth."""
    code = np.random.default_rng(7).uniform(0, 1, 9)
    # Odd sides: the highest frequency of even ones has no sign.
    light, velocity = np.zeros((15, 33), np.float32), (0.37, -0.83)
    made = coded_blur(light, light + 1, light == 0, code, margin=6, model_error=0.0)
    shape = made.light.shape
    along = made.along((-velocity[0], -velocity[1]) if broken else velocity)
    even = replace(along, power=np.ones_like(along.power))

    def forth(x: Doubles) -> Doubles:
        fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1])
        places = np.arange(9) - 4
        turns = np.exp(-2j * np.pi * (fy * velocity[0] + fx * velocity[1])[..., None] * places)
        return np.fft.ifft2(np.fft.fft2(x) * (turns @ (code / code.sum()))).real

    def back(y: Doubles) -> Doubles:
        return replace(made, spectrum=spectrum_of(y)).wiener(even)

    return _mismatch(forth, back, shape, _SINGLE, np.float32)


def _variation(*, broken: bool) -> float:
    """First step of total variation, its bound out of reach, as a dense matrix: I - step D'D."""
    shape, time_weight = (4, 5, 3), 0.7
    step = 1 / (4 + 2 * time_weight**2)
    columns = [
        smoothed(each.reshape(shape), 1e30, 1, time_weight=time_weight).ravel()
        for each in np.eye(60, dtype=np.float32)
    ]
    pixels = np.arange(60).reshape(shape)
    expected = np.eye(60)
    for axis, weight in enumerate((1.0, 1.0, time_weight)):
        after = np.roll(pixels, -1, axis)
        pairs = np.stack([pixels, after], -1).swapaxes(0, axis)
        # Wrong: the last of a line has the first as its neighbour.
        pairs = (pairs if broken else pairs[:-1]).reshape(-1, 2)
        difference = weight * (np.eye(60)[pairs[:, 1]] - np.eye(60)[pairs[:, 0]])
        expected -= step * difference.T @ difference
    error = np.stack(columns, axis=1) - expected
    return float(error.ravel()[np.abs(error).argmax()] / _SINGLE)
