# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
"""A made film of textured discs that move over a textured ground, and exposures of it.

No prior was trained on it, but it is of the kind that the shipped mixture learned from: moving leaves
(:mod:`optsim.scene.dead_leaves`), there with photographs and patterns for textures; the shipped dictionary
learned from renders of ``scenes/training_mix``. Ground and discs are dead leaves (A. B. Lee, D. Mumford and
J. Huang, Int. J. Comput. Vis. 41, 35 (2001)): flat patches of many sizes that hide each other, whose edges
are as sharp as the pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import cast

import numpy as np
from scipy import ndimage

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import CodedFrame, Doubles, ExposureCode, Floats, Words

Textured = Callable[[int, np.random.Generator], Floats]

# Samples of a pixel's side, and instants of a slot: what moves 1.5 px a slot moves 0.4 px in an instant.
_FINE, _INSTANTS = 2, 4
_DISCS = 5
# Fastest disc and ground, pixels a slot, and turn of a disc, rad a slot: sensible defaults, no source.
_FASTEST, _DRIFT, _TURN = 1.5, 0.15, 0.03
# Smallest leaf's radius, pixels.
_LEAST_LEAF = 3.0
# Brightest pixel of an exposure, of what saturates it.
_EXPOSED = 2 / 3


def dead_leaves(side: int, rng: np.random.Generator) -> Floats:
    """Flat discs whose radii fall as the inverse cube, the later ones in front: (side, side), 0.05 .. 1."""
    texture = np.full((side, side), 0.5, np.float32)
    least, most = _LEAST_LEAF, side / 8
    n = 20 * side
    radii = (least**-2 - rng.random(n) * (least**-2 - most**-2)) ** -0.5
    middles, values = rng.uniform(0, side, (n, 2)), rng.uniform(0.05, 1, n).astype(np.float32)
    for radius, (v, u), value in zip(radii, middles, values, strict=True):
        top, left = max(0, int(v - radius)), max(0, int(u - radius))
        part = texture[top : int(v + radius) + 2, left : int(u + radius) + 2]
        dv, du = np.arange(top, top + part.shape[0]) - v, np.arange(left, left + part.shape[1]) - u
        part[dv[:, None] ** 2 + du**2 < radius**2] = value
    return texture


def made_film(
    rows: int, cols: int, slots: int, rng: np.random.Generator, textured: Textured = dead_leaves
) -> Floats:
    """Light of a film: slot means of shape (slot, v, u), float32, from 0.05 to 1 with leaves for textures.

    Parameters
    ----------
    rows, cols, slots : int
        Pixels and slots.
    rng : numpy.random.Generator
        Draws textures, places and velocities.
    textured : callable
        Makes a square texture of a side, in pixels: first that of the ground, then those of the discs.
    """
    ground = textured(2 * max(rows, cols), rng)
    radii = rng.uniform(0.08, 0.2, _DISCS) * min(rows, cols)
    skins = [textured(int(4 * radius), rng) for radius in radii]
    start = rng.uniform(0.2, 0.8, (_DISCS, 2)) * (rows, cols)
    angle, speed = rng.uniform(0, 2 * np.pi, _DISCS), rng.uniform(0.2, 1, _DISCS) * _FASTEST
    velocity = speed[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1)
    turn = rng.uniform(-_TURN, _TURN, _DISCS)
    v = (np.arange(rows * _FINE) + 0.5) / _FINE
    u = (np.arange(cols * _FINE) + 0.5) / _FINE
    film = np.zeros((slots, rows, cols), np.float32)
    for slot in range(slots):
        for instant in range(_INSTANTS):
            time = slot + (instant + 0.5) / _INSTANTS
            picture = looked_up(ground, v[:, None] + _DRIFT * time, u + 0.5 * _DRIFT * time)
            for skin, radius, place, way, rate in zip(skins, radii, start, velocity, turn, strict=True):
                middle = place + way * (time - slots / 2)
                rows_near = np.flatnonzero(np.abs(v - middle[0]) < radius)
                cols_near = np.flatnonzero(np.abs(u - middle[1]) < radius)
                dv, du = v[rows_near, None] - middle[0], u[cols_near] - middle[1]
                c, s = np.cos(rate * time), np.sin(rate * time)
                near = looked_up(skin, 2 * radius + c * dv - s * du, 2 * radius + s * dv + c * du)
                where = np.ix_(rows_near, cols_near)
                picture[where] = np.where(dv**2 + du**2 < radius**2, near, picture[where])
            film[slot] += picture.reshape(rows, _FINE, cols, _FINE).mean(axis=(1, 3))
    return film / np.float32(_INSTANTS)


def photograph(
    calibration: Calibration, code: ExposureCode, film: Iterable[Floats], rng: np.random.Generator
) -> tuple[CodedFrame, float]:
    """Expose a film through a code, with shot and read noise, whole numbers and 14 bits.

    Parameters
    ----------
    calibration : Calibration
        The camera, taken to be exactly that.
    code : ExposureCode
        Code of the frame.
    film : iterable of ndarray of shape (v, u)
        Light of each slot, any unit.
    rng : numpy.random.Generator
        Of the noise.

    Returns
    -------
    frame : CodedFrame
    scale : float
        Irradiance of a light of 1, W m^-2: the brightest pixel is exposed to two thirds of its saturation.
    """
    exposure = _expected_dn(calibration, code, film)
    scale = float((_EXPOSED * (calibration.saturation_dn - calibration.black_dn) / exposure.max()).min())
    return CodedFrame(0, _read_out(calibration, exposure * scale, rng), code), scale


def exposed(
    calibration: Calibration, index: int, code: ExposureCode, film: Iterable[Floats], rng: np.random.Generator
) -> CodedFrame:
    """Expose as :func:`photograph` does, but light in W m^-2 as it comes; the panel has no memory."""
    return CodedFrame(index, _read_out(calibration, _expected_dn(calibration, code, film), rng), code)


def _expected_dn(calibration: Calibration, code: ExposureCode, film: Iterable[Floats]) -> Floats:
    """DN above black that light of 1 W m^-2 in the film's unit would give, (v, u)."""
    weights, _ = calibration.weights(code, None)
    light = sum(weight * picture for weight, picture in zip(weights, film, strict=True))
    return calibration.spread(np.asarray(light, np.float32)[None])[0] * calibration.responsivity_dn


def _read_out(calibration: Calibration, above_black_dn: Floats, rng: np.random.Generator) -> Words:
    """Raw DN of the whole sensor with shot and read noise; what no pixel is picked from stays 0."""
    electrons = rng.poisson(above_black_dn / calibration.dn_per_e)
    noisy = calibration.black_dn + electrons * calibration.dn_per_e
    noisy = noisy + rng.normal(0, calibration.read_noise_dn, noisy.shape)
    shape = calibration.ccd_shape
    dn = np.zeros(shape, np.uint16)
    dn[calibration.centre_row, calibration.centre_col] = np.rint(np.clip(noisy, 0, 2**14 - 1))
    return dn


def looked_up(texture: Floats, v: Doubles, u: Doubles) -> Floats:
    """Texture at places (v, u), linear between its pixels."""
    places = np.stack(np.broadcast_arrays(v, u))
    return cast("Floats", ndimage.map_coordinates(texture, places, order=1, mode="mirror", output=np.float32))
